"""Machine code on disk, in a folder private to the user, because what lies there is run.

Each file holds a digest. One that is damaged or that somebody else owns is made again; a folder
that cannot be used costs time only, and is told of once in a process.
"""

import contextlib
import hashlib
import logging
import os
import re
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

CodeKind = Literal["o", "loop"]
"""Object code of kernels, or loops that Numba compiled."""

_MAGIC = b"lagid-kernel-1\n"
_DIGEST_SIZE = 32
_MAX_FILES = 2_000
"""Each update of lagid leaves some fifty behind; those not used for the longest time go."""
_CACHE_FILE_NAME = re.compile(r"[0-9a-f]{64}\.(o|loop)")
_ADVICE = "set LAGID_CACHE_DIR to a folder that this user alone can write to"
_log = logging.getLogger(__name__)
_logged_reasons: list[str] = []


def digest_files(paths: Iterable[Path], root: Path) -> str:
    """SHA-256 of some files below `root`: of their places there and of what they hold.

    Raises
    ------
    OSError
        If a file cannot be read.
    """
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(str(path.relative_to(root)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def find_cache_folder() -> Path:
    """Folder of compiled code: `LAGID_CACHE_DIR`, or ``~/.cache/lagid``.

    Raises
    ------
    OSError
        If the user has no home.
    """
    chosen = os.environ.get("LAGID_CACHE_DIR")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    if base:
        return Path(base) / "lagid"
    try:
        return Path.home() / ".cache" / "lagid"
    except RuntimeError as error:
        raise OSError("this user has no home folder") from error


def _find_code_folder(kind: CodeKind) -> Path:
    """Where a kind is kept: as Numba's own cache, loops follow `NUMBA_CACHE_DIR` if it is set."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    return Path(chosen) if chosen and kind == "loop" else find_cache_folder()


def load_code(key: str, kind: CodeKind = "o") -> bytes | None:
    """Code kept under a key; None if there is none that can be trusted."""
    name = f"{key}.{kind}"
    try:
        folder = _find_code_folder(kind)
        if not _is_private(folder):
            return None
        with (folder / name).open("rb") as file:
            if _belongs_to_another(os.fstat(file.fileno())):
                return None
            content = file.read()
        with contextlib.suppress(OSError):  # in a folder that may only be read
            os.utime(folder / name)  # what is used stays the longest
    except OSError:
        return None
    start = len(_MAGIC) + _DIGEST_SIZE
    if content[:start] == _MAGIC + _compute_digest(name, content[start:]):
        return content[start:]
    with contextlib.suppress(OSError):
        (folder / name).unlink()
    return None


def store_code(key: str, code: bytes, kind: CodeKind = "o") -> None:
    """Keep code under a key, whole or not at all; a folder that cannot be used is no error."""
    folder = None
    try:
        folder = _find_code_folder(kind)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_private(folder):
            warn_not_cached(
                f"{folder} belongs to another user, or others may write to it; {_ADVICE}"
            )
            return
        _write_file(folder, f"{key}.{kind}", code)
        _prune_files(folder)
    except OSError as error:
        why = error if folder is None else f"{folder}: {error.strerror}"
        warn_not_cached(f"{why}; {_ADVICE}")


def _write_file(folder: Path, name: str, code: bytes) -> None:
    handle, temporary = tempfile.mkstemp(dir=folder)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(_MAGIC + _compute_digest(name, code) + code)
        os.replace(temporary, folder / name)
    except OSError:
        os.unlink(temporary)
        raise


def warn_not_cached(why: str) -> None:
    """Log why compiled code is not kept, once in a process."""
    if not _logged_reasons:
        _logged_reasons.append(why)
        _log.warning("compiled code is not kept, so every process compiles it anew: %s", why)


def _compute_digest(name: str, code: bytes) -> bytes:
    return hashlib.sha256(name.encode() + code).digest()


def _belongs_to_another(status: os.stat_result) -> bool:
    return hasattr(os, "getuid") and status.st_uid != os.getuid()


def _is_private(folder: Path) -> bool:
    """Whether nobody else may write there."""
    if not hasattr(os, "getuid"):
        return True
    status = folder.stat()
    return not _belongs_to_another(status) and not status.st_mode & 0o022


def _prune_files(folder: Path) -> None:
    """Remove the files beyond the most that are kept; other processes may do so meanwhile."""
    files = [one.path for one in os.scandir(folder) if _CACHE_FILE_NAME.fullmatch(one.name)]
    if len(files) <= _MAX_FILES:
        return
    used = []
    for path in files:
        with contextlib.suppress(FileNotFoundError):
            used.append((os.stat(path).st_mtime_ns, path))
    for _, path in sorted(used)[: len(used) - _MAX_FILES]:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)
