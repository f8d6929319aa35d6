"""Recordings: records, holds, initial history, resampling, splitting, derivation, noise."""
