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
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.runtime.nrt import rtsys

_SOURCES = (
    "ga/*.py", "kernels/caching.py", "kernels/calls.py", "kernels/evaluation.py",
    "kernels/evaluator.py", "plants/*.py", "least_squares.py", "refinement.py",
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


class _LightImpl(CompileResultCacheImpl):
    """What is kept of a compiled function: nothing that makes its loading import the compiler."""

    def reduce(self, cres: Any) -> tuple[Any, ...]:
        """The function without empty environments of others.

        An environment holds a function's Python constants, and to make it again imports the
        function's module: for Numba's own versions of NumPy a good part of the compiler.
        """
        *kept, environments = super().reduce(cres)  # type: ignore[no-untyped-call]
        return (*kept, tuple(one for one in environments if one.consts))


class _SourcesCache(FunctionCache):
    """Numba's cache of one function, its key widened by the digest of the sources."""

    _impl_class = _LightImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Machine code from the cache, None if it holds none.

        Numba's own method first registers all that could be compiled, a quarter of a second; what
        is loaded needs the memory management alone. The compiler registers it where it runs.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]

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
