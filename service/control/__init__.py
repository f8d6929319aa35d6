"""Simulation of runs and closed loops."""
