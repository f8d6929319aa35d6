"""Errors, settings, wire base types, validation messages, JSON pointers, concurrency limit."""
