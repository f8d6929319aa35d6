"""Errors, types, settings, threads, JIT and code cache, units: what everything may use."""
