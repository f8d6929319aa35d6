"""What holds for every test: the threads it has, the shared fixtures."""

import os

# Set before NumPy is loaded. On the small matrices of these tests a second BLAS thread only waits
# for a processor, and beside other work that costs many times the computation. Workers have one
# thread as well.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

pytest_plugins = ["tests.profiles", "tests.database", "tests.cluster", "tests.needs"]
