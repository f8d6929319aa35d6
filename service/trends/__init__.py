"""Trend of a batch: points, drift, notes."""
