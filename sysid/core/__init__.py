"""Foundations of the numerical core: errors, types, settings, threads, code cache, units."""
