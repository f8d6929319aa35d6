"""Figures of one run, as plain Plotly JSON: one definition for all who draw them."""
