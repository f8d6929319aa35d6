"""Temporary files that name the process that made them, so that those of the dead can go.

The name holds the machine (boot and PID namespace), the number and the start of the process:
containers that share a folder have the same host name and numbers, but not these.
"""

import os
import re
import shutil
import time
from contextlib import suppress
from pathlib import Path

from service.core.processes import has_process_ended, read_start
from sysid.core.machine import make_machine_tag

STALE_SECONDS = 24 * 3600
"""After so long a file is nobody's, whichever machine it came from."""


def make_temporary_prefix() -> str:
    """What the names of this process's temporary files begin with."""
    return f"lagid-tmp-{make_machine_tag()}-{os.getpid()}-{read_start(os.getpid()) or 0}-"


def remove_leftovers(folder: Path, pattern: str = "lagid-tmp-*") -> None:
    """Remove files and folders of processes of this machine that are gone, and stale ones."""
    for path in folder.glob(pattern):
        with suppress(FileNotFoundError):  # its owner, or another that clears, was faster
            if _has_dead_owner(path.name) or _is_stale(path):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _has_dead_owner(name: str) -> bool:
    found = re.match(rf"lagid-tmp-{make_machine_tag()}-(\d+)-(\d+)-", name)
    return found is not None and has_process_ended(int(found[1]), int(found[2]) or None)


def _is_stale(path: Path) -> bool:
    return time.time() - path.stat().st_mtime > STALE_SECONDS
