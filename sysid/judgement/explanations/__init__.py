"""Explanations of what an estimate leaves of the data, a file for each family."""
