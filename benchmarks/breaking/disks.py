"""Small file systems for a service's files, which can be filled and emptied."""

import contextlib
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

BLOCK = 4096


@contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[Path | None]:
    """A file system of that size at `folder`; None where it cannot be mounted, as without root."""
    folder.mkdir(parents=True, exist_ok=True)
    options = f"size={megabytes}m"
    command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
    try:
        is_mounted = subprocess.run(command, check=False, capture_output=True).returncode == 0
    except FileNotFoundError:
        is_mounted = False
    if not is_mounted:
        yield None
        return
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@contextmanager
def fill_folders(*folders: Path) -> Iterator[None]:
    """No space is left on the file systems of these folders for the length of the block."""
    ballast = [folder / "ballast" for folder in folders]
    try:
        for file in ballast:
            fill(file)
        yield
    finally:
        for file in ballast:
            file.unlink(missing_ok=True)


def fill(file: Path) -> None:
    """Write a file until nothing more fits; more is added to one that is there."""
    with file.open("ab", buffering=0) as ballast, contextlib.suppress(OSError):
        for size in (1 << 20, BLOCK):
            with contextlib.suppress(OSError):
                while ballast.write(b"\0" * size) == size:
                    pass
