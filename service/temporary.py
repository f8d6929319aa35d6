"""Temporary files that name the process that made them, so that those of the dead can go."""

import os
import shutil
import socket
import time
from pathlib import Path

from workers.processes import is_running

STALE_SECONDS = 24 * 3600
"""After so long a file is nobody's, whichever machine it came from."""


def prefix() -> str:
    """What the names of this process's temporary files begin with."""
    return f"{_prefix_here()}{os.getpid()}-"


def clear(folder: Path, pattern: str = "lagid-tmp-*") -> None:
    """Remove files and folders of processes of this machine that are gone, and stale ones."""
    for path in folder.glob(pattern):
        owner = path.name.removeprefix(_prefix_here()).partition("-")[0]
        is_ours = path.name.startswith(_prefix_here()) and owner.isdigit()
        if (is_ours and not is_running(int(owner))) or _is_stale(path):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _prefix_here() -> str:
    return f"lagid-tmp-{socket.gethostname()}-"


def _is_stale(path: Path) -> bool:
    return time.time() - path.stat().st_mtime > STALE_SECONDS
