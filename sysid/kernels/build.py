"""From a model to the address of its kernel; compiled once per machine, loaded once per process."""

import hashlib
from dataclasses import replace
from functools import cache
from pathlib import Path

from sysid.core.code_cache import digest_files, store, stored
from sysid.core.memo import cache_by_identity
from sysid.kernels.kernel import KERNEL, kernel_code
from sysid.kernels.layout import Variant
from sysid.kernels.machine_code import loaded, machine_name, object_code_bounded
from sysid.models.model import EstimatedInitial, Model

_addresses: dict[str, int] = {}


def kernel_address(model: Model, variant: Variant) -> int:
    """Address of the model's kernel in this process, for `sysid.kernels.abi.call_kernel`."""
    key = kernel_key(model, variant)
    if key not in _addresses:
        code = stored(key)
        if code is None:
            code = object_code_bounded(kernel_code(model, variant))
            store(key, code)
        _addresses[key] = loaded(code, KERNEL)
    return _addresses[key]


@cache_by_identity  # it is a long walk, and many runs have one model
def kernel_key(model: Model, variant: Variant) -> str:
    """Name of a kernel: what its code depends on, and nothing else.

    Bounds, units, titles and the grid's step are data of the problem; changing them compiles
    nothing.
    """
    starts = tuple(
        "estimated" if isinstance(start, EstimatedInitial) else type(start).__name__
        for start in model.initial
    )
    parts = (
        model.form == "differential",
        [quantity.name for quantity in model.inputs],
        [quantity.name for quantity in model.states],
        [output.expression for output in model.outputs],
        [parameter.name for parameter in model.parameters],
        model.equations, starts, model.order, model.memory,
        replace(model.solver, step=None), variant, machine_name(), _writers(),
    )  # fmt: skip
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@cache
def _writers() -> str:
    """Digest of what writes kernels: a new version of it makes new kernels."""
    package = Path(__file__).parents[1]
    sources = (*package.glob("kernels/*.py"), package / "language" / "functions.py")
    return digest_files(sources, package)
