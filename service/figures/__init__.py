"""Figures of sweeps, trends and loops; any figure as CSV, SVG or part of a page."""
