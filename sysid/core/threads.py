"""One thread for the linear algebra, so that sums are added in the same order everywhere.

NumPy and SciPy each load an OpenBLAS. OpenBLAS splits long arrays over all threads of the
machine, and the last digits of a sum depend on their number. The numerical core uses NumPy's
library. SciPy's, which takes long to load, is limited too if it is loaded before the first use.
"""

import ctypes
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

_MAPS_FILE = Path("/proc/self/maps")
_BUNDLED = ("numpy.libs", "numpy/.dylibs", "scipy.libs", "scipy/.dylibs")
_PREFIXES, _SUFFIXES = ("", "scipy_"), ("", "64_", "_64")


class _BlasLibrary(NamedTuple):
    get_threads: Callable[[], int]
    set_threads: Callable[[int], object]


class _ThreadLimit:
    """Number of callers that need one thread, and the libraries' thread counts before."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._callers = 0
        self._before: list[int] = []

    def acquire(self) -> None:
        with self._lock:
            self._callers += 1
            if self._callers == 1:
                self._before = [library.get_threads() for library in _load_libraries()]
                for library in _load_libraries():
                    library.set_threads(1)

    def release(self) -> None:
        with self._lock:
            self._callers -= 1
            if self._callers == 0:
                for library, count in zip(_load_libraries(), self._before, strict=True):
                    library.set_threads(count)


_thread_limit = _ThreadLimit()


@contextmanager
def use_one_thread() -> Iterator[None]:
    """Limit linear algebra to one thread in the process, until the last caller leaves."""
    _thread_limit.acquire()
    try:
        yield
    finally:
        _thread_limit.release()


@lru_cache(maxsize=1)
def _load_libraries() -> tuple[_BlasLibrary, ...]:
    """Load every OpenBLAS of this process; other linear algebra libraries stay unchanged."""
    libraries = []
    for path in sorted(_find_library_paths()):
        loaded = ctypes.CDLL(path)
        for prefix, suffix in product(_PREFIXES, _SUFFIXES):
            limit = getattr(loaded, f"{prefix}openblas_set_num_threads{suffix}", None)
            count = getattr(loaded, f"{prefix}openblas_get_num_threads{suffix}", None)
            if limit is not None and count is not None:
                limit.argtypes, limit.restype = (ctypes.c_int,), None
                count.argtypes, count.restype = (), ctypes.c_int
                libraries.append(_BlasLibrary(count, limit))
                break
    return tuple(libraries)


def _find_library_paths() -> set[str]:
    """Find the files of OpenBLAS: on Linux the loaded ones, else those of NumPy and SciPy."""
    if _MAPS_FILE.exists():
        mapped = (line.split(maxsplit=5) for line in _MAPS_FILE.read_text().splitlines())
        files = {parts[5] for parts in mapped if len(parts) == 6}
        return {file for file in files if "openblas" in Path(file).name and Path(file).exists()}
    site = Path(np.__file__).parents[1]
    return {str(path) for part in _BUNDLED for path in (site / part).glob("*openblas*")}
