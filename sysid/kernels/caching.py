"""Compiled functions that are kept on disk until any source of compiled code changes.

Numba keys a cached function by its own file only. A compiled function contains those that it
calls, so after an update of another file the old machine code would run on, silently. Here the
key holds a digest of all the files that compiled functions come from.
"""

from collections.abc import Callable
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core.caching import FunctionCache

_SOURCES = (
    "ga/*.py", "kernels/caching.py", "kernels/calls.py", "kernels/evaluation.py",
    "kernels/evaluator.py", "plants/*.py",
)  # fmt: skip
_Function = TypeVar("_Function", bound=Callable[..., Any])


@lru_cache(maxsize=1)
def fingerprint() -> str:
    """Digest of the sources of all compiled functions."""
    package = Path(__file__).parents[1]
    digest = sha256()
    for pattern in _SOURCES:
        for source in sorted(package.glob(pattern)):
            digest.update(source.name.encode())
            digest.update(source.read_bytes())
    return digest.hexdigest()


class _SourcesCache(FunctionCache):
    """Numba's cache of one function, its key widened by the digest of the sources."""

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        key: tuple[Any, ...] = super()._index_key(sig, codegen)  # type: ignore[no-untyped-call]
        return (*key, fingerprint())


def compiled(function: _Function) -> _Function:
    """Compile with Numba: cached on disk, the GIL released, division as in IEEE 754.

    No `fastmath`: ``isfinite`` must work, and a run must give the same bits on every worker.
    """
    made: Any = numba.njit(nogil=True, error_model="numpy")(function)
    made._cache = _SourcesCache(function)  # type: ignore[no-untyped-call]
    return cast(_Function, made)
