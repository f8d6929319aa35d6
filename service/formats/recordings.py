"""Read a recording from a file of any kind: the one reader of Python, command line and service."""

import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Protocol, TypeAlias, runtime_checkable

from service.formats.file_kinds import GZIP_MAGIC, detect_kind, read_head
from service.formats.read_options import DEFAULT_OPTIONS, Clock, ReadOptions, build_options
from sysid.core.errors import InvalidRecord, UnreadableFile
from sysid.data.foreign_tables import describe_value, is_labelled
from sysid.data.joining import join_recordings
from sysid.data.records import Recording
from sysid.data.table_rules import tell_notes
from sysid.inspection.inspect import check_recording


@runtime_checkable
class Readable(Protocol):
    """An open file, or another object that can be read."""

    def read(self) -> bytes | str:
        """Return the content that is left."""


Source: TypeAlias = str | os.PathLike[str] | bytes | Readable
"""A file's path, its content, or an open file."""


def read_recording(
    source: Source | Sequence[Source],
    *,
    sample_time: float | None = None,
    segments: Sequence[str] | str = (),
    columns: Sequence[str] | str = (),
    missing: Sequence[str | float] | str = (),
    exclude: Sequence[str] | str = (),
    clock: Clock = "log",
) -> Recording:
    r"""Read a recording: text of columns, Excel, Parquet, NumPy, MATLAB or MCAP.

    Everything that is guessed is told as a warning, `ReadingNote`. So is what happened to the
    recording, as `check_recording` finds it. Times are in s from the start;
    the clock of the file is `Recording.started_at`.

    Parameters
    ----------
    source : path, bytes or open file, or a sequence of them
        A file's path, its content, or an object that can be read. Several files, each with its
        own times, are joined on one clock; nothing is resampled.
    sample_time : float or None
        Sampling period in s, for a file without a time column.
    segments : sequence of str
        Columns of labels that divide the rows into segments, each measured on its own. A text
        has commas between names.
    columns : sequence of str
        Names of the columns of a file without a header, ``"t,u,,y [V]"``. A column with an empty
        name is left out.
    missing : sequence of str or float
        Words and numbers that mark bad data, ``"-9999,Offline"``. If there are any, no other
        number is taken for one; ``"none"`` says that no number is.
    exclude : sequence of str
        Ranges of times (s) or values, and words of a column: ``"t=100:200,flow=90:,state=Bad"``.
        Rows of times or words are cut out, values are missing.
    clock : {"log", "publish", "stamp"}
        Times of an MCAP file: when a message was logged or sent, or the stamp in its header.

    Raises
    ------
    UnreadableFile
        If the file cannot be used; in one line, with the name, the row and the column.
    FileNotFoundError
        If there is no such file.

    Examples
    --------
    >>> content = b"t [ms],valve [%],flow [l/min]\n0,0,1.5\n100,50,1.6\n200,50,2.8\n"
    >>> import warnings
    >>> with warnings.catch_warnings(action="ignore"):
    ...     recording = read_recording(content)
    >>> recording.names, recording.channel("flow").unit, recording.duration
    (('valve', 'flow'), 'l/min', 0.2)
    """
    options = build_options(
        sample_time=sample_time,
        segments=segments,
        columns=columns,
        missing=missing,
        exclude=exclude,
        clock=clock,
    )
    recording, notes = read_with_notes(source, options)
    tell_notes((*notes, *(one.sentences for one in check_recording(recording))))
    return recording


def read_with_notes(
    source: Source | Sequence[Source], options: ReadOptions = DEFAULT_OPTIONS
) -> tuple[Recording, tuple[str, ...]]:
    """Read a recording, and return the notes with it; see `read_recording`.

    Plain text is read by this process, every other file by a child with limits.
    """
    if isinstance(source, list | tuple):
        return _read_several(source, options)
    content = source.read() if isinstance(source, Readable) else source
    if isinstance(content, str) and content is not source:
        content = content.encode()
    if isinstance(content, bytes):
        from service.core.process.temporary_files import make_temporary_prefix

        with NamedTemporaryFile(prefix=make_temporary_prefix()) as file:
            file.write(content)
            file.flush()
            return _read_file(Path(file.name), options)
    if not isinstance(source, str | os.PathLike):
        raise UnreadableFile(
            f"found {describe_value(source)}; need the path of a file, its content as bytes, or "
            f"an open file.{_NO_FILE if is_labelled(source) else ''}"
        )
    try:
        return _read_file(Path(source), options)
    except UnreadableFile as error:
        error.name = str(source)
        raise


def _read_several(
    sources: Sequence[Source], options: ReadOptions
) -> tuple[Recording, tuple[str, ...]]:
    """Read files and join them on one clock; the notes of each name it."""
    if not sources:
        raise UnreadableFile("there is no file in the list; need one or more")
    recordings: dict[str, Recording] = {}
    notes: list[str] = []
    for number, source in enumerate(sources, 1):
        recording, told = read_with_notes(source, options)
        if len(sources) == 1:
            return recording, told
        name = f"file {number}"
        if isinstance(source, str | os.PathLike):
            name = Path(source).stem
        name = name if name not in recordings else f"{name} {number}"
        recordings[name] = recording
        notes += [f"{name}: {note}" for note in told]
    try:
        recording, joined = join_recordings(recordings)
    except InvalidRecord as error:
        raise UnreadableFile(str(error)) from None
    return recording, (*notes, *joined)


_NO_FILE = " A table is a recording already: give it to identify, or to Recording"


def _read_file(path: Path, options: ReadOptions) -> tuple[Recording, tuple[str, ...]]:
    if path.is_dir():
        raise UnreadableFile("it is a folder; need a file")
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}")
    from service.formats.tabular.csv_recordings import read_csv

    is_packed = read_head(path).startswith(GZIP_MAGIC)  # unpacking needs limits
    is_plain = detect_kind(path, path.suffix) == "csv" and not is_packed
    if is_plain and options.clock == DEFAULT_OPTIONS.clock:
        return read_csv(path, options)
    from service.formats.sandbox import read_untrusted

    upload = read_untrusted(path, options, suffix=path.suffix)
    return upload.recording, upload.notes
