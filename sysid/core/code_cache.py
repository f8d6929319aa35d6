"""Cache of machine code on disk.

The folder is private to the user, because its content is executed. Each file holds a digest. A
file that is damaged or belongs to another user is compiled again. An unusable folder costs time
only and is logged once in a process.
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
"""Object code of a kernel (``o``), or a function compiled by Numba (``loop``)."""

_MAGIC = b"lagid-kernel-2\n"
_DIGEST_SIZE = 32
_MAX_FILES = 2_000
"""Of each kind; the least recently used are removed. An update of lagid adds about ninety loops."""
_STEM = re.compile(r"[0-9a-f]{64}")
_ADVICE = "set LAGID_CACHE_DIR to a folder that only this user can write to"
_log = logging.getLogger(__name__)
_logged_reasons: list[str] = []


def digest_files(paths: Iterable[Path], root: Path) -> str:
    """Compute the SHA-256 digest of files below `root`: their relative paths and contents.

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
    """Return the folder of compiled code: `LAGID_CACHE_DIR`, or ``~/.cache/lagid``.

    Raises
    ------
    OSError
        If the user has no home folder.
    """
    configured = os.environ.get("LAGID_CACHE_DIR")
    if configured:
        return Path(configured)
    base = os.environ.get("XDG_CACHE_HOME")
    if base:
        return Path(base) / "lagid"
    try:
        return Path.home() / ".cache" / "lagid"
    except RuntimeError as error:
        raise OSError("this user has no home folder") from error


def _find_code_folder(kind: CodeKind) -> Path:
    """Return the folder of one kind of code; loops follow `NUMBA_CACHE_DIR`, as in Numba."""
    configured = os.environ.get("NUMBA_CACHE_DIR")
    return Path(configured) if configured and kind == "loop" else find_cache_folder()


def load_code(key: str, kind: CodeKind = "o") -> bytes | None:
    """Load the code stored under a key; None if there is none that can be trusted."""
    name = f"{key}.{kind}"
    try:
        folder = _find_code_folder(kind)
        if not _is_private(folder):
            return None
        with (folder / name).open("rb") as file:
            if _belongs_to_another(os.fstat(file.fileno())):
                return None
            content = file.read()
        with contextlib.suppress(OSError):  # the folder may be read-only
            os.utime(folder / name)  # marks the file as recently used
    except OSError:
        return None
    start = len(_MAGIC) + _DIGEST_SIZE
    if content[:start] == _MAGIC + _compute_digest(name, content[start:]):
        return content[start:]
    with contextlib.suppress(OSError):
        (folder / name).unlink()
    return None


def store_code(key: str, code: bytes, kind: CodeKind = "o") -> None:
    """Store code under a key, atomically; an unusable folder is logged, not raised."""
    folder = None
    try:
        folder = _find_code_folder(kind)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_private(folder):
            warn_not_cached(
                f"{folder} belongs to another user, or other users may write to it; {_ADVICE}"
            )
            return
        _write_file(folder, f"{key}.{kind}", code)
        _prune_files(folder, kind)
    except OSError as error:
        reason = error if folder is None else f"{folder}: {error.strerror}"
        warn_not_cached(f"{reason}; {_ADVICE}")


def _write_file(folder: Path, name: str, code: bytes) -> None:
    handle, temporary = tempfile.mkstemp(dir=folder)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(_MAGIC + _compute_digest(name, code) + code)
        os.replace(temporary, folder / name)
    except OSError:
        os.unlink(temporary)
        raise


def warn_not_cached(reason: str) -> None:
    """Log why compiled code is not cached, once in a process."""
    if not _logged_reasons:
        _logged_reasons.append(reason)
        _log.warning("compiled code is not cached, so every process compiles it again: %s", reason)


def _compute_digest(name: str, code: bytes) -> bytes:
    return hashlib.sha256(name.encode() + code).digest()


def _belongs_to_another(status: os.stat_result) -> bool:
    return hasattr(os, "getuid") and status.st_uid != os.getuid()


def _is_private(folder: Path) -> bool:
    """Whether only this user may write to the folder."""
    if not hasattr(os, "getuid"):
        return True
    status = folder.stat()
    return not _belongs_to_another(status) and not status.st_mode & 0o022


def _prune_files(folder: Path, kind: CodeKind) -> None:
    """Remove the oldest files of a kind beyond `_MAX_FILES`; other processes may do so meanwhile.

    A user's models are many. They must not push out the search, which takes a minute to compile.
    """
    files = [
        entry.path
        for entry in os.scandir(folder)
        if entry.name.endswith(f".{kind}") and _STEM.fullmatch(entry.name.removesuffix(f".{kind}"))
    ]
    if len(files) <= _MAX_FILES:
        return
    dated = []
    for path in files:
        with contextlib.suppress(FileNotFoundError):
            dated.append((os.stat(path).st_mtime_ns, path))
    for _, path in sorted(dated)[: len(dated) - _MAX_FILES]:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)
