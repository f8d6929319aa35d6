"""Read uploads in a separate process with limits of memory and time.

An uploaded file reaches C code (decompressors, protobuf) before any check. So a child process reads
it and writes its content again with our writer. This process reads only that copy.
"""

import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import file_digest
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from service.core.errors import Unavailable
from service.core.process import temporary_files
from service.formats.file_kinds import detect_kind
from service.formats.limits import MIB, UploadLimits
from service.formats.mcap.mcap_files import read_mcap
from service.formats.read_options import DEFAULT_OPTIONS, ReadOptions
from sysid.core.child_processes import OUT_OF_PROCESSOR_TIME, run_child
from sysid.core.errors import Advice, UnreadableFile
from sysid.data.records import Recording

OUT_OF_MEMORY = ("MemoryError", "memory allocation of", "failed to allocate", "bad_alloc")
"""What the reader's libraries write on stderr if they get no memory."""


@dataclass(frozen=True, slots=True, eq=False)
class UploadedRecording:
    """An uploaded recording.

    Attributes
    ----------
    notes : tuple of str
        Notes for the user: what was guessed, missing values, irregular times, skipped topics.
    source_sha256 : str
        Hash of the uploaded bytes.
    """

    recording: Recording
    notes: tuple[str, ...]
    source_sha256: str


def read_untrusted(
    path: str | os.PathLike[str], options: ReadOptions = DEFAULT_OPTIONS, *, suffix: str = ""
) -> UploadedRecording:
    """Read an uploaded file of any kind.

    Parameters
    ----------
    suffix : str
        Suffix of the name that the user gave the file; see `file_kinds.detect_kind`.

    Raises
    ------
    UnreadableFile
        If the file cannot be used for any reason.
    Unavailable
        If the disk of temporary files is full.
    """
    source, limits = Path(path), options.limits
    size = source.stat().st_size
    if size > limits.file_bytes:
        raise UnreadableFile(f"the file has {size} bytes; at most {limits.file_bytes} are read")
    with source.open("rb") as stream:
        sha256 = file_digest(stream, "sha256").hexdigest()
    with TemporaryDirectory(prefix=temporary_files.make_temporary_prefix()) as folder:
        clean = Path(folder) / "clean.mcap"
        task = {
            "source": str(source.absolute()),
            "target": str(clean),
            "kind": detect_kind(source, suffix),
            "options": options.to_document(),
        }
        notes = _parse_answer(_run_child(task, limits, folder), limits)
        return UploadedRecording(read_mcap(clean, limits), notes, sha256)


def _run_child(
    task: dict[str, Any], limits: UploadLimits, folder: str
) -> "subprocess.CompletedProcess[bytes]":
    try:
        return run_child(
            "service.formats.sandbox_child",
            json.dumps(task).encode(),
            seconds=limits.seconds,
            folder=folder,
        )
    except subprocess.TimeoutExpired:
        raise _build_timeout_error(limits) from None


def _parse_answer(
    child: "subprocess.CompletedProcess[bytes]", limits: UploadLimits
) -> tuple[str, ...]:
    if child.returncode == OUT_OF_PROCESSOR_TIME:
        raise _build_timeout_error(limits)
    try:
        answer = json.loads(child.stdout)
        if "error" in answer:
            raise _build_error(**answer["error"])
        if answer.get("is_disk_full"):
            raise Unavailable(temporary_files.FULL_DISK_MESSAGE)
        return tuple(answer["notes"])
    except (json.JSONDecodeError, KeyError, TypeError):
        errors = child.stderr.decode(errors="replace")
        reason = (errors.strip().splitlines() or ["no message"])[-1]
        if any(word in errors for word in OUT_OF_MEMORY) or child.returncode == -9:
            raise UnreadableFile(
                f"reading the file needs more than {limits.memory_bytes // MIB} MiB of memory"
            ) from None
        raise UnreadableFile(
            f"the file crashes its reader (exit code {child.returncode}: {reason[:200]})"
        ) from None


def _build_error(what: str, advice: Sequence[str] | None = None, **place: Any) -> UnreadableFile:
    return UnreadableFile(what, None if advice is None else Advice(*advice), **place)


def _build_timeout_error(limits: UploadLimits) -> UnreadableFile:
    return UnreadableFile(f"reading the file takes more than {limits.seconds:g} s")
