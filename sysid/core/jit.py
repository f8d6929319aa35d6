"""Just-in-time compilation with a disk cache that a change of the sources invalidates.

Numba's own cache keys a function by its own file only. A compiled function contains the functions
that it calls. After an update of another file the old machine code would silently run on. Here
the key holds a digest of all files that the function's module imports, directly or through
others. The code is stored with the kernels (`sysid.core.code_cache`): private, atomically
written, with a digest.

The cache uses internals of Numba. If these are not as expected, functions are compiled without a
cache and a warning is logged.

The search takes about a minute to compile, once after an installation. A line on stderr says so,
and `read_clock` does not count it.
"""

import itertools
import os
import pickle
import re
import secrets
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, TypeVar, cast

import llvmlite
import numba
import numpy as np
from numba.core.bytecode import FunctionIdentity
from numba.core.compiler import Compiler, CompilerBase

from sysid.core.code_cache import digest_files, load_code, store_code, warn_not_cached

_SOURCE_PATTERNS = (
    "search/*.py",
    "islands/*.py",
    "kernels/**/*.py",
    "simulation/*.py",
    "uncertainty/disturbances.py",
    "uncertainty/local_algebra.py",
    "uncertainty/sensitivities.py",
    "residuals/restricted_likelihood.py",
    "judgement/decaying_sums.py",
)
_VERSIONS = (numba.__version__, llvmlite.__version__, np.__version__, sys.version)
_LONG_TO_COMPILE = "sysid.islands.evolve"  # its function holds the whole search
COMPILATION_NOTE = "compiling the search, once after an installation: about a minute"
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


def _number_functions() -> None:
    """Number compiled functions from a random start, so that no two processes give one name.

    A compiled function's name holds its number, and Numba counts from 1 in each process. Under one
    name two functions share what is linked by names, as the Python constants of what they return.
    With stored functions of other processes such names would meet.
    """
    inside: Any = FunctionIdentity
    inside._unique_ids = itertools.count(secrets.randbits(62))


_number_functions()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_number_functions)


# Two patterns that begin with plain text: one with `^` would take ten times as long.
_IMPORTS = re.compile(rb"from (sysid[\w.]*)"), re.compile(rb"import (sysid[\w.]*)")


class Source(NamedTuple):
    """A file with compiled functions, or with values that they take.

    Attributes
    ----------
    digest : str
    imports : frozenset of str
        The modules and packages of sysid that it names after `from` or `import`.
    """

    digest: str
    imports: frozenset[str]


class Sources:
    """Sources of all compiled functions at one moment, by the names of their modules."""

    def __init__(self, modules: Mapping[str, Source]) -> None:
        self.modules = modules
        self._packages = {name.rpartition(".")[0] for name in modules}
        self._digests: dict[str, str] = {}

    def find_imported(self, module: str) -> set[str]:
        """Find a module and all that it imports, directly or through others.

        Of a named package all modules count. A module outside of the sources may import any.
        """
        if module not in self.modules:
            return set(self.modules)
        imported, waiting = {module}, [module]
        while waiting:
            named = set().union(*map(self._list_modules, self.modules[waiting.pop()].imports))
            waiting += named - imported
            imported |= named
        return imported

    def _list_modules(self, name: str) -> set[str]:
        """List the modules that the name of a module or package stands for."""
        if name in self._packages:
            return {m for m in self.modules if f"{m}.".startswith(f"{name}.")}
        return {name} & self.modules.keys()

    def compute_digest(self, module: str) -> str:
        """Compute the digest of a module and all that it imports."""
        if module not in self._digests:
            parts = [(m, self.modules[m].digest) for m in sorted(self.find_imported(module))]
            self._digests[module] = sha256(repr(parts).encode()).hexdigest()
        return self._digests[module]


def read_sources() -> Sources:
    """Read the sources of all compiled functions.

    Raises
    ------
    OSError
        If a file cannot be read.
    """
    package = Path(__file__).parents[1]
    modules = {}
    for path in (f for pattern in _SOURCE_PATTERNS for f in package.glob(pattern)):
        parts = path.relative_to(package.parent).with_suffix("").parts
        name = ".".join(part for part in parts if part != "__init__")
        content = path.read_bytes()
        imports = {match.decode() for pattern in _IMPORTS for match in pattern.findall(content)}
        modules[name] = Source(sha256(content).hexdigest(), frozenset(imports))
    return Sources(modules)


# Read before any module with a compiled function is loaded: all of them import this one.
_SOURCES = read_sources()


def get_sources_digest(module: str) -> str:
    """Return the digest of what a module imports, as it was at the start of this process."""
    return _SOURCES.compute_digest(module)


@cache
def _digest_file(source: str) -> str | None:
    """Digest of a file; None if it cannot be read."""
    try:
        return digest_files([Path(source)], Path(source).parent)
    except OSError:
        return None


class CompilationWatch(threading.local):
    """How long each thread has compiled functions, and a line where that takes long.

    Attributes
    ----------
    begun : float or None
        Reading of the clock when the present compilation began; None: nothing is compiled.
    seconds : float
        Duration of all compilations before.
    """

    def __init__(self, clock: Callable[[], float] = perf_counter) -> None:
        self._clock, self._depth = clock, 0
        self.begun: float | None = None
        self.seconds = 0.0

    def begin(self, module: str) -> None:
        """Note that a function of a module is about to be compiled."""
        if self.begun is None and self._depth:
            self.begun = self._clock()
        if module == _LONG_TO_COMPILE:
            _announce_once()

    @contextmanager
    def watch_function(self) -> Iterator[None]:
        """Note the end of what is begun inside; functions that it calls are compiled meanwhile."""
        self._depth += 1
        try:
            yield
        finally:  # also if the user interrupts it
            self._depth -= 1
            if self._depth == 0 and self.begun is not None:
                self.seconds += self._clock() - self.begun
                self.begun = None

    def read_clock(self) -> float:
        """Read a clock in seconds that stands still while this thread compiles functions."""
        return (self._clock() if self.begun is None else self.begun) - self.seconds


@cache
def _announce_once() -> None:
    _announce(COMPILATION_NOTE)


def _print_on_stderr(line: str) -> None:
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()


_announce: Callable[[str], object] = _print_on_stderr
_watch = CompilationWatch()
read_clock = _watch.read_clock


@contextmanager
def announce_compilation(write_line: Callable[[str], object]) -> Iterator[None]:
    """Give the line that the search is compiled to `write_line` instead of stderr."""
    global _announce
    before, _announce = _announce, write_line
    try:
        yield
    finally:
        _announce = before


class _FunctionCache:
    """Cache of one function, with the interface that Numba's dispatcher expects."""

    cache_path = None

    def __init__(self, function: Callable[..., Any]) -> None:
        self._code = function.__code__
        self._module = function.__module__
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._source = _digest_file(self._code.co_filename)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load the compiled function for a signature; None if no usable one is stored."""
        function = None
        try:
            content = load_code(self._compute_key(sig, target_context), "loop")
            function = None if content is None else _rebuild_function(content, target_context)
        except _CACHE_ERRORS as error:
            warn_not_cached(f"{self._name} is not loaded ({error!r})")
        if function is None:
            _watch.begin(self._module)
        return function

    def save_overload(self, sig: Any, compiled_: Any) -> None:
        """Store a compiled function, unless it contains addresses of this process.

        Nothing is stored if sources have changed since the process began (an update in place). The
        process may have loaded some of them before the update and some after it.
        """
        try:
            if read_sources().modules != _SOURCES.modules:
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
        """Do nothing: a newly compiled function replaces the stored one."""

    def _compute_key(self, sig: Any, target_context: Any) -> str:
        if self._source is None:
            raise OSError(f"{self._code.co_filename} cannot be read")
        parts = (
            get_sources_digest(self._module),
            _VERSIONS,
            target_context.codegen().magic_tuple(),
            self._name,
            self._code.co_firstlineno,
            self._source,
            str(sig),
        )
        return sha256(repr(parts).encode()).hexdigest()


def _serialize_function(compiled_: Any) -> bytes:
    """Pickle a function and the names that it defines, without empty environments.

    An environment holds a function's Python constants. Rebuilding it imports the function's
    module. For Numba's own versions of NumPy functions that is a good part of the compiler.
    """
    from numba.core.serialize import dumps

    parts = compiled_._reduce()
    if len(parts) == _REDUCED_PARTS:
        parts = (*parts[:-1], tuple(part for part in parts[-1] if part.consts))
    module = compiled_.library._get_module_for_linking()
    defined = (*module.functions, *module.global_variables)
    names = {symbol.name for symbol in defined if not symbol.is_declaration}
    return bytes(dumps((names, *parts)))


def _rebuild_function(content: bytes, target_context: Any) -> Any:
    """Rebuild a pickled function in this process.

    Numba's own cache first registers everything that could be compiled, which takes a quarter of
    a second. A loaded function needs only the memory management. Numba's cache also parses the
    bitcode to list the defined symbols. Here the names are stored, and the bitcode is parsed only
    if the compiler asks for it.

    Numba unpickles its own pickles. As with the machine code itself, this is safe: only files
    that this user alone can have written are read (`sysid.core.code_cache`).
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
    stored = (name, kind, (machine_code, parse_assembly("").as_bitcode()))
    rebuilt = inside._rebuild(target_context, stored, *others)
    rebuilt.library._get_module_for_linking = partial(_link_module, rebuilt.library, bitcode)
    return rebuilt


def _link_module(library: Any, bitcode: bytes) -> Any:
    """Parse the module of a loaded function, when a function that calls it is compiled."""
    from llvmlite.binding import parse_bitcode

    del library._get_module_for_linking  # from now on Numba's own method is used
    library._shared_module = parse_bitcode(bitcode)
    return library._shared_module


def _watch_compilation(compile_signature: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Wrap the method of a function that loads or compiles it for a signature."""

    def compile_watched(sig: Any) -> Any:
        with _watch.watch_function():
            return compile_signature(sig)

    return compile_watched


def _do_nothing() -> None:
    """Stand in for Numba's search for extensions of itself."""


def jit_compile(function: _Function, compiler: type[CompilerBase] = Compiler) -> _Function:
    """Compile with Numba: cached on disk, GIL released, IEEE 754 division.

    `compiler` is Numba's, or one with more passes such as that of `sysid.kernels.borrowing`.

    No `fastmath`: ``isfinite`` must work, and a run must give the same bits on every worker.
    """
    options = {"nogil": True, "error_model": "numpy", "pipeline_class": compiler}
    compiled: Any = numba.njit(**options)(function)
    if hasattr(compiled, "_cache"):
        compiled._cache = _FunctionCache(function)
        compiled.compile = _watch_compilation(compiled.compile)
        # Numba would read the metadata of all installed packages to find extensions of itself,
        # before it asks the cache. It reads them again if it compiles.
        compiled._compilation_chain_init_hook = _do_nothing
    elif compiled is not function:  # they are the same if NUMBA_DISABLE_JIT is set
        warn_not_cached(f"Numba {numba.__version__} has no function cache in the expected place")
    return cast(_Function, compiled)
