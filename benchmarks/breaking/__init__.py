"""A whole service to be broken: for `benchmarks/torture.py` and `tests/faults`."""
