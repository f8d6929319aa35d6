"""Recordings in and out: CSV, MCAP, derivations."""
