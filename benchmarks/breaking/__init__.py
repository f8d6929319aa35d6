"""A whole service and its faults, for `benchmarks/torture.py` and `tests/faults`."""
