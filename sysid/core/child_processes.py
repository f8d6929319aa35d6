"""Start programs of this package as child processes that import what this process imports.

Python puts the working folder first on the import path of `python -m`. A module of that folder,
such as a `numpy.py`, would then be run instead of the real one.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from math import ceil
from pathlib import Path

SAFE_FOLDER = "/"
"""Working folder of children: always there, and only the administrator writes to it."""
OUT_OF_PROCESSOR_TIME = -24
"""Exit code of a child that has reached its limit of processor time (SIGXCPU)."""
_ROOT = str(Path(__file__).resolve().parents[2])
# Variables that an interpreter may need to start. Children get no secret of this process.
_INHERITED_VARIABLES = ("PATH", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH")
CODE_CACHE_VARIABLES = ("LAGID_CACHE_DIR", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME")
"""Where compiled code is, for children that run it (`sysid.core.code_cache`)."""


def build_child_command(module: str, *arguments: str) -> list[str]:
    """Build the command that runs a module of this package, without the working folder's."""
    return [sys.executable, "-P", "-m", module, *arguments]


def build_import_path() -> str:
    """Build `PYTHONPATH` for a child: the import path of this process, but no working folder.

    The folder of this package stays, also if it is the working folder.
    """
    try:
        working = os.getcwd()
    except FileNotFoundError:  # it was deleted
        working = ""
    entries = [os.path.normpath(os.path.join(working, entry)) for entry in sys.path if entry]
    refused = {working} - {_ROOT}
    kept = [entry for entry in entries if os.path.isabs(entry) and entry not in refused]
    if _ROOT not in kept:
        kept.append(_ROOT)
    return os.pathsep.join(dict.fromkeys(kept))


def run_child(
    module: str,
    task: bytes,
    *,
    seconds: float,
    folder: str = SAFE_FOLDER,
    variables: Sequence[str] = (),
) -> "subprocess.CompletedProcess[bytes]":
    """Run a module of this package on one task: its input, for at most `seconds` of wall time.

    The module limits itself by `limit_resources`.

    Parameters
    ----------
    variables : sequence of str
        Environment variables that the child inherits besides those of its interpreter.

    Raises
    ------
    subprocess.TimeoutExpired
        If it takes longer.
    """
    names = (*_INHERITED_VARIABLES, *variables)
    inherited = {name: os.environ[name] for name in names if name in os.environ}
    return subprocess.run(
        build_child_command(module),
        cwd=folder,
        input=task,
        capture_output=True,
        timeout=seconds,
        env={
            **inherited,
            "PYTHONPATH": build_import_path(),
            "OPENBLAS_NUM_THREADS": "1",  # its threads' stacks would count as memory
            "PYTHONUTF8": "1",
        },
        check=False,
    )


def limit_resources(*, seconds: float, memory_bytes: int, file_bytes: int) -> None:
    """Limit processor time, address space and files of this process, where the system can."""
    if os.name != "posix":
        return
    import resource

    for limit, value in (
        (resource.RLIMIT_AS, memory_bytes),
        (resource.RLIMIT_CPU, ceil(seconds)),
        (resource.RLIMIT_FSIZE, file_bytes),
        (resource.RLIMIT_CORE, 0),
    ):
        _, hard = resource.getrlimit(limit)
        allowed = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(limit, (allowed, allowed if limit != resource.RLIMIT_CPU else hard))
