"""Equation text → checked tree: grammar, scopes, delays, intervals, printing."""
