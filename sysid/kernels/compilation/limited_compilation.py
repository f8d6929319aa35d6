"""Compilation of kernels, only ever in a child process with limits of time and memory.

A document of a few kilobytes can keep LLVM busy for hours, and take all memory. LLVM also leaves
about 0.3 MB of each module in memory until its process ends, and services live for weeks.
"""

import subprocess
from threading import Lock
from time import perf_counter

from sysid.core.child_processes import OUT_OF_PROCESSOR_TIME, run_child
from sysid.core.errors import Fault, InvalidModel
from sysid.kernels.compilation.compile_task import CompileTask, encode_task
from sysid.kernels.layout import KernelVariant
from sysid.models.model import Model

PROCESSOR_SECONDS = 60.0
"""A model of `sysid.models.equations.MAX_NODES` with few delays takes 40 s on a slow machine."""
MEMORY_BYTES = 2 * 1024**3
_WALL_SECONDS = 4 * PROCESSOR_SECONDS  # on a busy machine
_spent = {"seconds": 0.0}  # by all threads
_spent_lock = Lock()


def compile_kernel(model: Model, variant: KernelVariant) -> bytes:
    """Compile a kernel to object code.

    Raises
    ------
    InvalidModel
        If that needs more time or memory than one model may take.
    OSError
        If no process can be started.
    """
    begun = perf_counter()
    try:
        task = encode_task(CompileTask(model, variant, PROCESSOR_SECONDS, MEMORY_BYTES))
        child = run_child("sysid.kernels.compilation.compiler_child", task, seconds=_WALL_SECONDS)
    except subprocess.TimeoutExpired:
        raise _build_error(f"{_WALL_SECONDS:g} s") from None
    finally:
        with _spent_lock:
            _spent["seconds"] += perf_counter() - begun
    if child.returncode == 0 and child.stdout:
        return child.stdout
    if child.returncode == OUT_OF_PROCESSOR_TIME:
        raise _build_error(f"{PROCESSOR_SECONDS:g} s of processor time")
    errors = child.stderr.decode(errors="replace")
    is_ended_by_signal = child.returncode < 0
    # Where CPython cannot allocate even an exception, it raises a SystemError instead.
    if is_ended_by_signal or "MemoryError" in errors or "\nSystemError" in errors:
        raise _build_error(f"{MEMORY_BYTES // 1024**2} MiB of memory")
    raise RuntimeError(f"the compiler ended with code {child.returncode}: {errors[-500:]}")


def get_compile_seconds() -> float:
    """Return the time in s that this process has waited for its compilers, for its operator."""
    return _spent["seconds"]


def _build_error(limit: str) -> InvalidModel:
    detail = (
        f"compiling them needs more than {limit}; write fewer or shorter equations, or fewer "
        "different delays"
    )
    return InvalidModel([Fault("/equations", detail)])
