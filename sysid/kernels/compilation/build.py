"""Building of kernels: compiled once on each machine, loaded once in each process.

A model that cannot be compiled is refused at once when a process meets it again: the runs of a
sweep share their model.
"""

import hashlib
from dataclasses import replace
from functools import cache
from pathlib import Path

from sysid.core.code_cache import digest_files, load_code, store_code
from sysid.core.errors import InvalidModel
from sysid.core.memo import cache_by_identity
from sysid.kernels.abi import KERNEL_NAME
from sysid.kernels.compilation.limited_compilation import compile_kernel
from sysid.kernels.compilation.machine_code import describe_machine, load_object_code
from sysid.kernels.layout import KernelVariant
from sysid.models.model import DerivedInitial, Model

_kernel_addresses: dict[str, int] = {}
_refused_kernels: dict[str, InvalidModel] = {}


def get_kernel_address(model: Model, variant: KernelVariant) -> int:
    """Return the address of a model's kernel, for `sysid.kernels.calls.call_kernel`.

    Raises
    ------
    InvalidModel
        If compiling it needs more time or memory than one model may take.
    """
    key = compute_kernel_key(model, variant)
    if key not in _kernel_addresses:
        code = load_code(key)
        if code is None:
            code = _compile_once(key, model, variant)
            store_code(key, code)
        _kernel_addresses[key] = load_object_code(code, KERNEL_NAME)
    return _kernel_addresses[key]


def _compile_once(key: str, model: Model, variant: KernelVariant) -> bytes:
    if key in _refused_kernels:
        raise InvalidModel(_refused_kernels[key].faults)
    try:
        return compile_kernel(model, variant)
    except InvalidModel as error:
        _refused_kernels[key] = error
        raise


@cache_by_identity  # hashing a model is slow, and many runs share one
def compute_kernel_key(model: Model, variant: KernelVariant) -> str:
    """Compute the cache key of a kernel from everything that its code depends on.

    Bounds, units, titles and the grid's step are data. Changing them does not recompile.
    """
    starts = tuple(
        start.expression if isinstance(start, DerivedInitial) else type(start).__name__
        for start in model.initial
    )
    parts = (
        model.form == "differential",
        [signal.name for signal in model.inputs],
        [signal.name for signal in model.states],
        [output.expression for output in model.outputs],
        [parameter.name for parameter in model.parameters],
        model.equations,
        starts,
        model.histories,
        model.corrections,
        model.order,
        model.memory,
        replace(model.solver, step=None),
        variant,
        describe_machine(),
        _digest_emitters(),
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@cache
def _digest_emitters() -> str:
    """Digest of the code generator: a new version makes new kernels."""
    package = Path(__file__).parents[2]
    names = ("functions.py", "table_functions.py", "time_switches.py")
    language = (package / "language" / name for name in names)
    sources = (*package.glob("kernels/**/*.py"), *language)
    return digest_files(sources, package)
