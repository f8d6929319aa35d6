"""Temporary files whose names identify their process, so that leftovers can be removed.

The name holds the machine (boot and PID namespace), and the number and the start of the process.
Containers that share a folder have the same host name and numbers, but not these.
"""

import errno
import os
import re
import shutil
import time
from contextlib import suppress
from pathlib import Path

from service.core.process.process_identity import has_process_ended, read_start
from sysid.core.machine import make_machine_tag

FULL_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT)
FULL_DISK_MESSAGE = "a disk of the server is full. Nothing was stored. Try again."
STALE_SECONDS = 24 * 3600
"""Age in s after which a file is removed, whichever machine it came from."""


def make_temporary_prefix() -> str:
    """Return the prefix of the names of this process's temporary files."""
    return f"lagid-tmp-{make_machine_tag()}-{os.getpid()}-{read_start(os.getpid()) or 0}-"


def remove_leftovers(folder: Path, pattern: str = "lagid-tmp-*") -> None:
    """Remove files and folders of ended processes of this machine, and stale ones."""
    for path in folder.glob(pattern):
        with suppress(FileNotFoundError):  # its owner or another cleaner was faster
            if _has_dead_owner(path.name) or _is_stale(path):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _has_dead_owner(name: str) -> bool:
    match = re.match(rf"lagid-tmp-{make_machine_tag()}-(\d+)-(\d+)-", name)
    return match is not None and has_process_ended(int(match[1]), int(match[2]) or None)


def _is_stale(path: Path) -> bool:
    return time.time() - path.stat().st_mtime > STALE_SECONDS
