"""Faults made by hand: each must make a test of the gate fail (`make mutants`)."""
