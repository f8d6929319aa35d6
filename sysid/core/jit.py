"""Compiled functions that are kept on disk until any source of compiled code changes.

Numba's own cache keys a function by its own file only. A compiled function contains those that it
calls, so after an update of another file the old machine code would run on, silently. Here the
key holds a digest of all the files that compiled functions come from, and the code lies where
kernels lie (`sysid.core.code_cache`): private, whole, with a digest.

What a compiled function consists of is known only to Numba's insides. Where these are not as
expected, functions are compiled as without a cache and the log says so.
"""

import pickle
import sys
from collections.abc import Callable
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite
import numba
import numpy as np

from sysid.core.code_cache import digest_files, load_code, store_code, warn_not_cached

_SOURCE_PATTERNS = (
    "search/*.py",
    "islands/*.py",
    "kernels/*.py",
    "plants/*.py",
    "simulation/*.py",
    "uncertainty/sensitivities.py",
)
_VERSIONS = (numba.__version__, llvmlite.__version__, np.__version__, sys.version)
_REDUCED_PARTS = 9  # of a compiled function; the last are environments
_CACHE_ERRORS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    pickle.PickleError,
)
_Function = TypeVar("_Function", bound=Callable[..., Any])


def _digest_sources() -> str:
    package = Path(__file__).parents[1]
    return digest_files((f for pattern in _SOURCE_PATTERNS for f in package.glob(pattern)), package)


# Read before any module with a compiled function is loaded, all of which load this one first.
_SOURCES_DIGEST = _digest_sources()


def get_sources_digest() -> str:
    """Digest of the sources of all compiled functions, as this process began with them."""
    return _SOURCES_DIGEST


@cache
def _digest_file(source: str) -> str | None:
    """Digest of a file, None if there is none."""
    try:
        return digest_files([Path(source)], Path(source).parent)
    except OSError:
        return None


class _FunctionCache:
    """What Numba asks of the cache of one function, by its dispatcher."""

    cache_path = None

    def __init__(self, function: Callable[..., Any]) -> None:
        self._code = function.__code__
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._source = _digest_file(self._code.co_filename)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The function for some types of arguments, None if none is kept that can be used."""
        try:
            content = load_code(self._compute_key(sig, target_context), "loop")
            return None if content is None else _rebuild_function(content, target_context)
        except _CACHE_ERRORS as error:
            warn_not_cached(f"{self._name} is not loaded ({error!r})")
            return None

    def save_overload(self, sig: Any, compiled_: Any) -> None:
        """Keep what was compiled, except code with addresses of this process in it.

        Neither where sources have changed since the process began (an update in place): it may
        have loaded some of them before and some after, and the others take what lies here.
        """
        try:
            if _digest_sources() != _SOURCES_DIGEST:
                warn_not_cached(f"{self._name}: sources have changed since this process began")
            elif not compiled_.library.has_dynamic_globals:
                store_code(
                    self._compute_key(sig, compiled_.target_context),
                    _serialize_function(compiled_),
                    "loop",
                )
        except _CACHE_ERRORS as error:
            warn_not_cached(f"{self._name} is not saved ({error!r})")

    def flush(self) -> None:
        """Nothing: what is compiled anew replaces what was kept."""

    def _compute_key(self, sig: Any, target_context: Any) -> str:
        if self._source is None:
            raise OSError(f"{self._code.co_filename} cannot be read")
        parts = (
            get_sources_digest(),
            _VERSIONS,
            target_context.codegen().magic_tuple(),
            self._name,
            self._code.co_firstlineno,
            self._source,
            str(sig),
        )
        return sha256(repr(parts).encode()).hexdigest()


def _serialize_function(compiled_: Any) -> bytes:
    """The function without empty environments of others, and the names that it defines.

    An environment holds a function's Python constants, and to make it again imports the
    function's module: for Numba's own versions of NumPy a good part of the compiler.
    """
    from numba.core.serialize import dumps

    parts = compiled_._reduce()
    if len(parts) == _REDUCED_PARTS:
        parts = (*parts[:-1], tuple(one for one in parts[-1] if one.consts))
    module = compiled_.library._get_module_for_linking()
    defined = (*module.functions, *module.global_variables)
    names = {one.name for one in defined if not one.is_declaration}
    return bytes(dumps((names, *parts)))  # type: ignore[no-untyped-call]


def _rebuild_function(content: bytes, target_context: Any) -> Any:
    """The function in this process.

    Numba's own cache first registers all that could be compiled, a quarter of a second; what is
    loaded needs the memory management alone. The compiler registers it where it runs. It also
    reads the function's bitcode, which only the compiler asks for, to tell what is defined.

    Numba unpickles what it has pickled: as with the machine code itself, this is safe because
    only files that this user alone can have written get here (`sysid.core.code_cache`).
    """
    from llvmlite.binding import parse_assembly
    from numba.core.compiler import CompileResult
    from numba.core.runtime.nrt import rtsys
    from numba.core.serialize import loads

    inside: Any = CompileResult
    initialize = getattr(rtsys, "initialize", None)
    if initialize is None:
        target_context.refresh()
    else:
        initialize(target_context)
    names, (name, kind, (machine_code, bitcode)), *others = loads(content)
    target_context.codegen()._engine._defined_symbols.update(names)
    without = (name, kind, (machine_code, parse_assembly("").as_bitcode()))
    rebuilt = inside._rebuild(target_context, without, *others)
    rebuilt.library._get_module_for_linking = partial(_link_module, rebuilt.library, bitcode)
    return rebuilt


def _link_module(library: Any, bitcode: bytes) -> Any:
    """The module of a loaded function, read where another is compiled that calls it."""
    from llvmlite.binding import parse_bitcode

    del library._get_module_for_linking  # Numba's own gives it from now on
    library._shared_module = parse_bitcode(bitcode)
    return library._shared_module


def jit_compile(function: _Function) -> _Function:
    """Compile with Numba: cached on disk, the GIL released, division as in IEEE 754.

    No `fastmath`: ``isfinite`` must work, and a run must give the same bits on every worker.
    """
    made: Any = numba.njit(nogil=True, error_model="numpy")(function)
    if hasattr(made, "_cache"):
        made._cache = _FunctionCache(function)
    elif made is not function:  # as it is where NUMBA_DISABLE_JIT is set
        warn_not_cached(
            f"Numba {numba.__version__} keeps no cache of functions where it is looked for"
        )
    return cast(_Function, made)
