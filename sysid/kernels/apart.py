"""Compiling in processes of their own, from the time a process has compiled many kernels itself.

What LLVM's passes leave behind of each module, about 0.3 MB, nothing frees before the process ends.
A service that is sent new models for weeks would grow by it; machine code itself is small.
"""

import logging
import os
import subprocess
import sys

from sysid.kernels.machine import object_code

OWN = 64
"""Kernels that a process compiles itself: it takes half a second less than to start another."""

_SECONDS = 300.0
_KEPT = ("PATH", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH")  # what an interpreter may need to start
_made: list[None] = []  # one entry for each, since += on a number is two steps of two threads
_log = logging.getLogger(__name__)


def object_code_bounded(assembly: str) -> bytes:
    """Compile assembly for this machine, here or, after `OWN` of them, in another process."""
    if len(_made) >= OWN:
        try:
            return _compiled_apart(assembly)
        except (OSError, subprocess.SubprocessError) as error:
            _log.warning("a kernel is compiled in this process, which keeps its traces: %s", error)
    _made.append(None)
    return object_code(assembly)


def _compiled_apart(assembly: str) -> bytes:
    # What this process imports and no more: `-m` alone would put the folder it stands in first.
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    kept = {name: os.environ[name] for name in _KEPT if name in os.environ}
    return subprocess.run(
        [sys.executable, "-P", "-m", "sysid.kernels.apart"],
        input=assembly.encode(),
        stdout=subprocess.PIPE,
        timeout=_SECONDS,
        env={**kept, "PYTHONPATH": path},
        check=True,
    ).stdout


if __name__ == "__main__":
    sys.stdout.buffer.write(object_code(sys.stdin.buffer.read().decode()))
