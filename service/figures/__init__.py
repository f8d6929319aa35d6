"""Figures: one Plotly definition each, also drawn as SVG; no rendering of pages."""
