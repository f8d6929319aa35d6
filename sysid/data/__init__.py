"""Recordings: channels, holds, history, resampling, splitting, derivation, noise."""
