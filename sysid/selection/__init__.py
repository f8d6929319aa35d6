"""Polynomial term selection (FROLS) and its lag search."""
