"""Signals of a kernel: states, inputs, and reads of their past."""
