"""Start programs of this package as child processes that import what this process imports.

Python puts the working folder first on the import path of `python -m`. A module of that folder,
such as a `numpy.py`, would then be run instead of the real one.
"""

import os
import sys
from pathlib import Path

SAFE_FOLDER = "/"
"""Working folder of children: always there, and only the administrator writes to it."""
_ROOT = str(Path(__file__).resolve().parents[2])


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
