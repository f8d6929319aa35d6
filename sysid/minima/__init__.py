"""Minima of the loss: scans, minima near the estimate, and whether the search settled."""
