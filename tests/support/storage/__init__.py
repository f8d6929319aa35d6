"""Databases, object stores and their rows for tests."""
