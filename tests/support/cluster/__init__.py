"""Dispatchers, Ray and nodes for tests."""
