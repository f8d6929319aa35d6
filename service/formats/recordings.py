"""Read a recording from a file of any kind: the one reader of Python, command line and service."""

import os
import warnings
from collections.abc import Sequence
from numbers import Real
from pathlib import Path
from tempfile import NamedTemporaryFile

from service.formats.errors import InvalidUpload
from service.formats.file_kinds import detect_kind
from service.formats.limits import DEFAULT_LIMITS, UploadLimits
from sysid.data.records import Recording


class ReadingNote(UserWarning):
    """What was guessed or found while a file was read."""


def read_recording(
    source: str | os.PathLike[str] | bytes,
    *,
    sample_time: float | None = None,
    segments: Sequence[str] = (),
    limits: UploadLimits = DEFAULT_LIMITS,
) -> Recording:
    r"""Read a recording: text of columns, Excel, Parquet, NumPy, MATLAB or MCAP.

    Everything that is guessed is told as a warning, `ReadingNote`. Times are in s from the start;
    the clock of the file is `Recording.started_at`.

    Parameters
    ----------
    source : path or bytes
        A file's path, or its content.
    sample_time : float or None
        Sampling period in s, for a file without a time column.
    segments : sequence of str
        Columns of labels that divide the rows into segments, each measured on its own.
    limits : UploadLimits

    Raises
    ------
    InvalidUpload
        If the file cannot be used; in one line, with the row and the column.
    FileNotFoundError
        If there is no such file.

    Examples
    --------
    >>> content = b"t [ms],valve [%],flow [l/min]\n0,0,1.5\n100,50,1.6\n200,50,2.8\n"
    >>> with warnings.catch_warnings(action="ignore"):
    ...     recording = read_recording(content)
    >>> recording.names, recording.channel("flow").unit, recording.duration
    (('valve', 'flow'), 'l/min', 0.2)
    """
    recording, notes = read_with_notes(
        source, sample_time=sample_time, segments=segments, limits=limits
    )
    for note in notes:
        warnings.warn(note, ReadingNote, stacklevel=2)
    return recording


def read_with_notes(
    source: str | os.PathLike[str] | bytes,
    *,
    sample_time: float | None = None,
    segments: Sequence[str] = (),
    limits: UploadLimits | None = None,
) -> tuple[Recording, tuple[str, ...]]:
    """Read a recording, and return the notes with it; see `read_recording`.

    Plain text is read by this process, every other file by a child with limits.
    """
    if isinstance(source, bytes):
        with NamedTemporaryFile(prefix="lagid-") as file:
            file.write(source)
            file.flush()
            return read_with_notes(
                file.name, sample_time=sample_time, segments=segments, limits=limits
            )
    _check_arguments(source, sample_time, segments)
    path, limits = Path(source), DEFAULT_LIMITS if limits is None else limits
    if path.is_dir():
        raise InvalidUpload(f"{path} is a folder; need a file")
    from service.formats.csv_recordings import is_plain_text, read_csv

    if detect_kind(path, path.suffix) == "csv" and is_plain_text(
        path, sample_time, segments, limits
    ):
        return read_csv(path, sample_time=sample_time, segments=segments, limits=limits)
    from service.formats.sandbox import read_untrusted

    upload = read_untrusted(
        path, limits, suffix=path.suffix, sample_time=sample_time, segments=segments
    )
    return upload.recording, upload.notes


def _check_arguments(source: object, sample_time: object, segments: object) -> None:
    """Refuse arguments of another kind, which Python lets through."""
    if not isinstance(source, str | os.PathLike):
        raise InvalidUpload(f"found {source!r}; need the path of a file, or its content as bytes")
    if sample_time is not None and not isinstance(sample_time, Real):
        raise InvalidUpload(f"sample_time is {sample_time!r}; need a positive number of seconds")
    if isinstance(segments, str):
        raise InvalidUpload(f"segments is {segments!r}; need a list of columns: [{segments!r}]")
