"""Reproduce the paper's tables and figures by real jobs; only `lagid paper` uses it."""
