"""The locks of a data folder: one `lagid serve` with a dispatcher, and who uses it at all.

The system releases it when its process ends, however that happens. So it is never stale.
"""

import errno
import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from service.core.errors import Misconfigured

_NAME, _USE_NAME = "serve.lock", "use.lock"
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
"""Errors of a file system without locks, where nothing can be checked."""


class FolderLock:
    """The lock while it is held."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def describe_holder(self, text: str) -> None:
        """Write who holds the lock, for the message of others."""
        self._file.truncate(0)
        self._file.write(text)
        self._file.flush()


@contextmanager
def lock_folder(folder: Path, advice: str) -> Iterator[FolderLock]:
    """Hold the lock of a data folder during the block.

    Raises
    ------
    Misconfigured
        If another process holds it; the message says which one, and ends with the advice.
    """
    with _open_file(folder.absolute() / _NAME) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip() or "another `lagid serve`"
            raise Misconfigured(f"{holder} works on {folder.absolute()}; {advice}") from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        lock = FolderLock(file)
        lock.describe_holder("")
        yield lock


@contextmanager
def use_folder(folder: Path, *, alone: bool = False) -> Iterator[None]:
    """Use the data of a folder during the block, beside others or `alone`.

    Raises
    ------
    Misconfigured
        If others use them who must not.
    """
    kind = fcntl.LOCK_EX if alone else fcntl.LOCK_SH
    with _open_file(folder.absolute() / _USE_NAME) as file:
        try:
            fcntl.flock(file, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            text = "`lagid restore` writes to {}; wait until it has ended"
            if alone:
                text = "a process of lagid uses {}; stop all of them first"
            raise Misconfigured(text.format(folder.absolute())) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        yield


def _open_file(path: Path) -> TextIO:
    try:
        return path.open("a+", encoding="utf-8")  # not emptied: it may be another's
    except OSError as error:
        raise Misconfigured(f"{path} cannot be opened ({error.strerror})") from error
