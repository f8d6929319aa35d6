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

_MAPS = Path("/proc/self/maps")
_BUNDLED = ("numpy.libs", "numpy/.dylibs", "scipy.libs", "scipy/.dylibs")
_PREFIXES, _SUFFIXES = ("", "scipy_"), ("", "64_", "_64")


class _Library(NamedTuple):
    threads: Callable[[], int]
    limit: Callable[[int], object]


class _Limit:
    """How many callers want one thread at present, and what the libraries had before."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._callers = 0
        self._before: list[int] = []

    def begin(self) -> None:
        with self._lock:
            self._callers += 1
            if self._callers == 1:
                self._before = [library.threads() for library in _libraries()]
                for library in _libraries():
                    library.limit(1)

    def end(self) -> None:
        with self._lock:
            self._callers -= 1
            if self._callers == 0:
                for library, count in zip(_libraries(), self._before, strict=True):
                    library.limit(count)


_limit = _Limit()


@contextmanager
def one_thread() -> Iterator[None]:
    """Linear algebra inside uses one thread, in the whole process until the last caller is done."""
    _limit.begin()
    try:
        yield
    finally:
        _limit.end()


@lru_cache(maxsize=1)
def _libraries() -> tuple[_Library, ...]:
    """Every OpenBLAS in this process; another library of linear algebra is left as it is."""
    found = []
    for path in sorted(_paths()):
        loaded = ctypes.CDLL(path)
        for prefix, suffix in product(_PREFIXES, _SUFFIXES):
            limit = getattr(loaded, f"{prefix}openblas_set_num_threads{suffix}", None)
            count = getattr(loaded, f"{prefix}openblas_get_num_threads{suffix}", None)
            if limit is not None and count is not None:
                limit.argtypes, limit.restype = (ctypes.c_int,), None
                count.argtypes, count.restype = (), ctypes.c_int
                found.append(_Library(count, limit))
                break
    return tuple(found)


def _paths() -> set[str]:
    """Files of OpenBLAS: on Linux those loaded, elsewhere those that NumPy and SciPy bring."""
    if _MAPS.exists():
        mapped = (line.split(maxsplit=5) for line in _MAPS.read_text().splitlines())
        files = {parts[5] for parts in mapped if len(parts) == 6}
        return {one for one in files if "openblas" in Path(one).name and Path(one).exists()}
    site = Path(np.__file__).parents[1]
    return {str(path) for part in _BUNDLED for path in (site / part).glob("*openblas*")}
