"""Weighted regression of estimates over a label (length, temperature)."""
