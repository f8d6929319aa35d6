"""Simulate a run, closed loops."""
