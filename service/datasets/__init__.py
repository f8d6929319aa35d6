"""Recordings stored, simulated, derived; lineage."""
