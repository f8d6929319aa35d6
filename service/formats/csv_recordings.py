"""CSV files as recordings.

The first column is ``t`` (also ``t_s``, ``time``, ``t [s]``) in seconds, or in the unit of time of
its heading (``t [min]``). Without it the sampling period must be given. The header may name units
in brackets (``u [V]``). Separators are comma, semicolon and tab. Decimal commas are detected if the
separator is not a comma. The text is UTF-8, with or without a byte-order mark.

An empty field or ``nan`` is a missing value and is reported. An output is not scored there, and an
input with a missing value cannot be used. Times must increase, except from one segment to the next.
Irregular times stay as they are; nothing is resampled.

Repeats of a measurement are segments, placed one after another on one time axis. A recording is
also written as CSV, block by block, and its numbers come back bit for bit.
"""

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO, StringIO, TextIOWrapper
from itertools import chain, islice
from math import floor, isfinite, log10, nan
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from service.core.text import escape_formula
from service.formats.csv_columns import ColumnValues, CsvTable, read_columns
from service.formats.csv_layout import CsvLayout, detect_layout, find_unit_seconds
from service.formats.errors import InvalidUpload
from service.formats.limits import DEFAULT_LIMITS, UploadLimits
from sysid.core.types import FloatArray, IntArray
from sysid.data.records import Channel, Recording, Segment, measure_sampling

SegmentLabels = Mapping[str, float | str]


def concatenate_segments(
    times: FloatArray, starts: IntArray, labels: Sequence[SegmentLabels]
) -> tuple[FloatArray, tuple[Segment, ...]]:
    """Place segments, whose own times may all begin at 0, on one time axis.

    Segment i begins at i steps. The step is the smallest of 1, 2, 5, 10, … · 10ᵏ s that is longer
    than every segment. So the position of a segment is easily read and its times stay exact.

    Parameters
    ----------
    times : FloatArray, shape (N,)
        Times of each segment in s, increasing within the segment.
    starts : IntArray, shape (n_segments,)
        Index of the first sample of each segment.
    labels : sequence of mappings, n_segments long
    """
    lasts = np.append(starts[1:], times.size) - 1
    step = _round_up_step(float(np.max(times[lasts] - times[starts])))
    axis = np.empty_like(times)
    segments = []
    for i, (first, last) in enumerate(zip(starts, lasts, strict=True)):
        origin, start = float(times[first]), i * step
        # Rounded to the ns of a file's clock, so that a stored time is read back unchanged.
        axis[first : last + 1] = np.round(start + (times[first : last + 1] - origin), 9)
        segments.append(Segment(start, float(axis[last]), origin, dict(labels[i])))
    return axis, tuple(segments)


def _round_up_step(longest: float) -> float:
    if longest <= 0:
        return 1.0
    decade = 10.0 ** floor(log10(longest))
    return next(step for m in (1, 2, 5, 10, 20) if (step := m * decade) > longest)


PEEK_LINES = 200
MAX_LINE_CHARACTERS = 1_000_000
EPOCH_THRESHOLD_SECONDS = 1e8
"""Times (s) that begin later than this (three years) are clock times since some epoch."""


def read_csv(
    source: Path | str | bytes,
    *,
    sample_time: float | None = None,
    segments: Sequence[str] = (),
    limits: UploadLimits = DEFAULT_LIMITS,
) -> tuple[Recording, tuple[str, ...]]:
    """Read a CSV file.

    Parameters
    ----------
    source : Path or str or bytes
        A file's path, or its content.
    sample_time : float or None
        Sampling period in s, for a file without a time column.
    segments : sequence of str
        Columns of labels, numbers or text. Consecutive rows with equal labels form a segment, and
        the time may restart with each segment. Segments follow each other on one axis.
    limits : UploadLimits
        Those of an MCAP file hold here too: signals, and rows as messages.

    Returns
    -------
    recording : Recording
    notes : tuple of str
        Notes for the user: missing values, irregular times, decimal commas.

    Raises
    ------
    InvalidUpload
        If the file cannot be used. The error has the row (the header is row 1) and the column.
    """
    with _open_text(source) as stream:
        lines = _iterate_lines(stream)
        first = list(islice(lines, PEEK_LINES))
        if not first:
            raise InvalidUpload("the file is empty; need a header and rows, such as t,u,y")
        if not first[0].strip():
            raise InvalidUpload("the first row is empty; need a header such as t,u,y", row=1)
        layout = detect_layout(first, segments, sample_time, limits.channels)
        table = read_columns(chain(first, lines), layout, limits.messages)
    notes = ["decimal commas were read as decimal points"] if layout.has_decimal_commas else []
    times, spans = _build_times(table, layout, sample_time, notes)
    return _build_recording(table, layout, times, spans, notes), tuple(notes)


@contextmanager
def _open_text(source: Path | str | bytes) -> Iterator[TextIOWrapper]:
    binary: BinaryIO
    with BytesIO(source) if isinstance(source, bytes) else Path(source).open("rb") as binary:
        head = binary.read(65536)
        binary.seek(0)
        if head.startswith((b"\xff\xfe", b"\xfe\xff")):
            raise InvalidUpload("the file is UTF-16 text; save it as CSV in UTF-8")
        if b"\0" in head:
            raise InvalidUpload("the file is not text; need CSV in UTF-8", byte=head.index(b"\0"))
        yield TextIOWrapper(binary, encoding="utf-8-sig", newline="")


def _iterate_lines(stream: TextIOWrapper) -> Iterator[str]:
    number = 0
    try:
        while line := stream.readline(MAX_LINE_CHARACTERS + 1):
            number += 1
            if len(line) > MAX_LINE_CHARACTERS:
                raise InvalidUpload(
                    f"the row is longer than {MAX_LINE_CHARACTERS} characters", row=number
                )
            yield line
    except UnicodeDecodeError as error:
        invalid_byte = error.object[error.start]
        raise InvalidUpload(
            f"the file is not UTF-8 text (byte 0x{invalid_byte:02x}); save it as CSV in UTF-8",
            row=_find_undecodable_row(cast(BinaryIO, stream.buffer)),
        ) from None


def _find_undecodable_row(binary: BinaryIO) -> int | None:
    # The decoder works on blocks of many rows, so the row is searched here.
    binary.seek(0)
    for number, raw in enumerate(iter(lambda: binary.readline(MAX_LINE_CHARACTERS), b""), 1):
        try:
            raw.decode()
        except UnicodeDecodeError:
            return number
    return None


def _build_times(
    table: CsvTable, layout: CsvLayout, sample_time: float | None, notes: list[str]
) -> tuple[FloatArray, tuple[Segment, ...]]:
    """Build the times on the recording's axis, and the segments."""
    labels = [column.name for column in layout.columns if column.role == "label"]
    starts = _find_segment_starts(table, labels)
    time_index = layout.time_index
    if time_index is None:
        assert sample_time is not None  # checked with the layout
        stops = [*starts[1:], table.rows.size]
        counts = [np.arange(b - a) for a, b in zip(starts, stops, strict=True)]
        times = np.concatenate(counts) * sample_time
    else:
        name = layout.columns[time_index].name
        times = _convert_to_seconds(
            table.parse_numbers(name), layout.columns[time_index].unit, notes
        )
        _check_increasing(times, starts, table, name)
        _report_repeated_times(times, starts, notes)
        times = _subtract_epoch(times, notes)
    if not labels:
        _report_irregular_sampling(times, notes)
        return times, ()
    values = {label: _parse_labels(table.columns[label]) for label in labels}
    segment_labels: list[SegmentLabels] = [
        {label: column[first] for label, column in values.items()} for first in starts
    ]
    axis, spans = concatenate_segments(times, starts, segment_labels)
    notes.append(f"{len(spans)} segments follow each other on one time axis")
    return axis, spans


def _find_segment_starts(table: CsvTable, labels: Sequence[str]) -> IntArray:
    changes = np.zeros(table.rows.size, dtype=bool)
    changes[0] = True
    for label in labels:
        column = table.columns[label]
        changes[1:] |= column[1:] != column[:-1]
    return np.flatnonzero(changes).astype(np.int64)


def _parse_labels(column: ColumnValues) -> list[float | str]:
    texts = [str(text) for text in column]
    try:
        numbers = [float(text) for text in texts]
    except ValueError:
        return list(texts)
    return list(numbers) if np.isfinite(numbers).all() else list(texts)


def _convert_to_seconds(times: FloatArray, unit: str, notes: list[str]) -> FloatArray:
    size = find_unit_seconds(unit) or 1.0
    if size == 1.0:
        return times
    notes.append(f"times were converted from {unit} to s: delays and time constants are in s")
    # Division by a whole number of units per second is correctly rounded, a product is not.
    converted: FloatArray = times * size if size > 1.0 else times / round(1.0 / size)
    return converted


def _check_increasing(times: FloatArray, starts: IntArray, table: CsvTable, name: str) -> None:
    steps = np.diff(times)
    # Repeats may be pooled, and pooled samples may share a time.
    stays = steps < 0 if starts.size > 1 else steps <= 0
    stays[starts[1:] - 1] = False
    wrong = np.flatnonzero(stays)
    if wrong.size == 0:
        return
    before, after = float(times[wrong[0]]), float(times[wrong[0] + 1])
    what = "repeats" if before == after else "decreases"
    raise InvalidUpload(
        f"the time {what}: {before!r} s is followed by {after!r} s. Times must increase from "
        "row to row. For repeated measurements, name their label columns with segments.",
        row=int(table.rows[wrong[0] + 1]),
        column=name,
    )


def _report_repeated_times(times: FloatArray, starts: IntArray, notes: list[str]) -> None:
    shared = np.diff(times) == 0
    shared[starts[1:] - 1] = False
    if count := int(np.count_nonzero(shared)):
        notes.append(f"{count} samples have the same time as the previous sample of their segment")


def _subtract_epoch(times: FloatArray, notes: list[str]) -> FloatArray:
    if float(np.min(times)) < EPOCH_THRESHOLD_SECONDS:
        return times
    notes.append(
        f"times are counted from the first sample, at {float(times[0])!r} s of the file's clock"
    )
    shifted: FloatArray = times - times[0]
    return shifted


def _report_irregular_sampling(times: FloatArray, notes: list[str]) -> None:
    sampling = measure_sampling(times)
    if sampling.samples > 1 and not sampling.is_regular:
        gaps = np.diff(times)
        notes.append(
            f"sampling is irregular: {gaps.min():.4g} to {gaps.max():.4g} s between samples, "
            f"median {sampling.period:.4g} s. Each sample is used at its own time."
        )


def _build_recording(
    table: CsvTable,
    layout: CsvLayout,
    times: FloatArray,
    spans: Iterable[Segment],
    notes: list[str],
) -> Recording:
    channels = []
    for column in layout.columns:
        if column.role != "value":
            continue
        values = table.parse_numbers(column.name)
        _report_missing_values(column.name, values, table, notes)
        channels.append(Channel(column.name, times, values, column.unit or "1"))
    return Recording(tuple(channels), tuple(spans))


def _report_missing_values(
    name: str, values: FloatArray, table: CsvTable, notes: list[str]
) -> None:
    missing = np.flatnonzero(np.isnan(values))
    if missing.size == 0:
        return
    if missing.size == values.size:
        raise InvalidUpload("every value is missing; leave the column out", column=name)
    notes.append(
        f"channel {name!r}: {missing.size} of {values.size} values are missing (empty or NaN), the "
        f"first in row {table.rows[missing[0]]}. An output is not scored at missing values. "
        "An input with missing values cannot be used."
    )


WRITTEN_BLOCK_ROWS = 5000


def generate_csv(recording: Recording) -> Iterator[str]:
    """Generate CSV text in blocks: time in s, label columns of segments, one column per channel.

    Within a segment the times are those of the segment. So an upload with ``?segments=`` and the
    label columns gives the same recording. A cell is empty where its channel has no sample. A text
    that a spreadsheet would take for a formula gets a leading apostrophe, which `read_csv` removes.
    """
    labels = sorted({name for segment in recording.segments for name in segment.labels})
    buffer = StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    headings = ["t", *labels, *(_format_heading(channel) for channel in recording.channels)]
    writer.writerow(map(escape_formula, headings))
    for number, row in enumerate(_iterate_rows(recording, labels), 1):
        writer.writerow(row)
        if number % WRITTEN_BLOCK_ROWS == 0:
            yield _drain_buffer(buffer)
    yield _drain_buffer(buffer)


def _iterate_rows(recording: Recording, labels: list[str]) -> Iterator[list[str]]:
    if not recording.segments:
        for time, values in _iterate_samples(recording):
            yield [repr(time), *values]
        return
    for segment, piece in zip(recording.segments, recording.split_segments(), strict=True):
        texts = [_format_value(segment.labels.get(name, "")) for name in labels]
        for time, values in _iterate_samples(piece):
            yield [repr(time), *texts, *values]


def _iterate_samples(recording: Recording) -> Iterator[tuple[float, list[str]]]:
    """Yield times in order, with the values of all channels; a missing value is empty.

    A time has one row, or as many as one channel has values at it.
    """
    groups: list[list[int]] = []
    channels = recording.channels
    for index, channel in enumerate(channels):
        for group in groups:
            if np.array_equal(channels[group[0]].times, channel.times):
                group.append(index)
                break
        else:
            groups.append([index])
    times = np.concatenate([channels[group[0]].times for group in groups])
    group_of_sample = np.concatenate(
        [np.full(channels[group[0]].times.size, number) for number, group in enumerate(groups)]
    )
    index_in_group = np.concatenate([np.arange(channels[group[0]].times.size) for group in groups])
    time, row, written = nan, [""] * len(channels), set[int]()
    for index in np.argsort(times, kind="stable").tolist():
        number = int(group_of_sample[index])
        if written and (time != times[index] or number in written):
            yield time, row
            row, written = [""] * len(channels), set()
        time = float(times[index])
        written.add(number)
        for member in groups[number]:
            row[member] = _format_value(float(channels[member].values[index_in_group[index]]))
    if written:
        yield time, row


def _format_value(value: float | str) -> str:
    if isinstance(value, str):
        return str(escape_formula(value))
    return repr(value) if isfinite(value) else ""


def _format_heading(channel: Channel) -> str:
    return channel.name if channel.unit == "1" else f"{channel.name} [{channel.unit}]"


def _drain_buffer(buffer: StringIO) -> str:
    text = buffer.getvalue()
    buffer.seek(0)
    buffer.truncate()
    return text
