"""One thread for the linear algebra, so that sums are made in the same order everywhere.

NumPy and SciPy each bring or load an OpenBLAS. It deals long arrays over as many threads as the
machine has, and the last digits of a sum depend on how many those are. What runs inside uses that
of NumPy; SciPy's is told too where it is loaded before the first use, and takes long to load.
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
    """How many callers want one thread at present, and what the libraries had before."""

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
    """Linear algebra inside uses one thread, in the whole process until the last caller is done."""
    _thread_limit.acquire()
    try:
        yield
    finally:
        _thread_limit.release()


@lru_cache(maxsize=1)
def _load_libraries() -> tuple[_BlasLibrary, ...]:
    """Every OpenBLAS in this process; another library of linear algebra is left as it is."""
    found = []
    for path in sorted(_find_library_paths()):
        loaded = ctypes.CDLL(path)
        for prefix, suffix in product(_PREFIXES, _SUFFIXES):
            limit = getattr(loaded, f"{prefix}openblas_set_num_threads{suffix}", None)
            count = getattr(loaded, f"{prefix}openblas_get_num_threads{suffix}", None)
            if limit is not None and count is not None:
                limit.argtypes, limit.restype = (ctypes.c_int,), None
                count.argtypes, count.restype = (), ctypes.c_int
                found.append(_BlasLibrary(count, limit))
                break
    return tuple(found)


def _find_library_paths() -> set[str]:
    """Files of OpenBLAS: on Linux those loaded, elsewhere those that NumPy and SciPy bring."""
    if _MAPS_FILE.exists():
        mapped = (line.split(maxsplit=5) for line in _MAPS_FILE.read_text().splitlines())
        files = {parts[5] for parts in mapped if len(parts) == 6}
        return {one for one in files if "openblas" in Path(one).name and Path(one).exists()}
    site = Path(np.__file__).parents[1]
    return {str(path) for part in _BUNDLED for path in (site / part).glob("*openblas*")}
