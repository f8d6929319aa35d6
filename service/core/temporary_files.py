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

from workers.processes import has_ended, standing, tag

STALE_SECONDS = 24 * 3600
"""After so long a file is nobody's, whichever machine it came from."""


def prefix() -> str:
    """What the names of this process's temporary files begin with."""
    here = standing(os.getpid())
    return f"lagid-tmp-{tag()}-{os.getpid()}-{0 if here is None else here.started}-"


def clear(folder: Path, pattern: str = "lagid-tmp-*") -> None:
    """Remove files and folders of processes of this machine that are gone, and stale ones."""
    for path in folder.glob(pattern):
        with suppress(FileNotFoundError):  # its owner, or another that clears, was faster
            if _is_of_the_dead(path.name) or _is_stale(path):
                shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _is_of_the_dead(name: str) -> bool:
    found = re.match(rf"lagid-tmp-{tag()}-(\d+)-(\d+)-", name)
    return found is not None and has_ended(int(found[1]), int(found[2]) or None)


def _is_stale(path: Path) -> bool:
    return time.time() - path.stat().st_mtime > STALE_SECONDS
