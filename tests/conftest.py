"""What holds for every test: the threads it has, how long it may take, the shared fixtures."""

import os

# Set before NumPy is loaded. On the small matrices of these tests a second BLAS thread only waits
# for a processor, and beside other work that costs many times the computation. Workers have one
# thread as well.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from hypothesis import HealthCheck, settings

# How long an example takes tells of the machine's load, not of the program.
settings.register_profile("lagid", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("lagid")

pytest_plugins = ["tests.database", "tests.cluster", "tests.needs"]
