"""Write files so that a failure leaves the old one whole."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import copymode
from tempfile import NamedTemporaryFile
from typing import IO


@contextmanager
def open_replacement(path: Path) -> Iterator[IO[bytes]]:
    """Open a file beside `path` that takes its place at the end, and is removed at an error.

    A link stays, and its target is replaced. What is no plain file, such as a pipe, is written
    to.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        with target.open("wb") as stream:
            yield stream
        return
    with NamedTemporaryFile(
        dir=target.parent, prefix=f".{target.name[:80]}.", suffix=".part", delete=False
    ) as stream:
        part = Path(stream.name)
        try:
            yield stream
            stream.close()
            _set_mode(part, target)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)


def _set_mode(part: Path, target: Path) -> None:
    """Give a file the permissions of the one that it replaces, else those of a new file."""
    if target.exists():
        copymode(target, part)
    else:
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o666 & ~mask)


def write_whole(path: Path, text: str) -> None:
    """Write a text in UTF-8 to a file; raises as `open_replacement`."""
    with open_replacement(path) as stream:
        stream.write(text.encode())
