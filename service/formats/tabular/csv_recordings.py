"""Text files of columns as recordings, and recordings as CSV.

What a text may look like is guessed by `service.formats.tabular.table_layout`. An empty field or a
word such as ``NA`` is a missing value. An output is not scored there, and an input is read across
it. Times must increase, except from one segment to the next; a few rows out of order are repaired.
Irregular times stay as they are; nothing is resampled.

Repeats of a measurement are segments, placed one after another on one time axis. A recording is
also written as CSV, block by block, and its numbers come back bit for bit.
"""

from collections.abc import Iterator
from itertools import chain, islice
from math import isfinite, nan
from pathlib import Path

import numpy as np

from service.core.label_text import write_csv
from service.formats.read_options import DEFAULT_OPTIONS, ReadOptions
from service.formats.tabular.table_columns import read_lines
from service.formats.tabular.table_layout import detect_layout
from service.formats.tabular.table_recordings import build_recording
from service.formats.tabular.text_files import open_text
from sysid.data.records import Channel, Recording


def read_csv(
    source: Path | str | bytes, options: ReadOptions = DEFAULT_OPTIONS
) -> tuple[Recording, tuple[str, ...]]:
    """Read a text file of columns.

    Parameters
    ----------
    source : Path or str or bytes
        A file's path, or its content.
    options : ReadOptions
        Labels of segments are numbers or text; segments follow each other on one axis. Limits of
        an MCAP file hold here too: signals, and rows as messages.

    Returns
    -------
    recording : Recording
    notes : tuple of str
        Notes for the user: what was guessed, and rows out of order.

    Raises
    ------
    UnreadableFile
        If the file cannot be used. The error has the row of the file, from 1, and the column.
    """
    notes: list[str] = []
    with open_text(source, options.limits, notes) as lines:
        layout, first = detect_layout(lines, options)
        notes += layout.notes
        table = read_lines(chain(first, lines), layout, notes, options.limits.messages)
    return build_recording(table, options, notes), tuple(notes)


WRITTEN_BLOCK_ROWS = 5000


def generate_csv(recording: Recording) -> Iterator[str]:
    """Generate CSV text in blocks: time in s, label columns of segments, one column per channel.

    Within a segment the times are those of the segment. So an upload with ``?segments=`` and the
    label columns gives the same recording. A cell is empty where its channel has no sample. A text
    that a spreadsheet would take for a formula gets a leading apostrophe, which `read_csv` removes.
    """
    labels = sorted({name for segment in recording.segments for name in segment.labels})
    headings: list[object] = [
        "t",
        *labels,
        *(_format_heading(channel) for channel in recording.channels),
    ]
    rows = chain([headings], _iterate_rows(recording, labels))
    while block := list(islice(rows, WRITTEN_BLOCK_ROWS)):
        yield write_csv(block)


def _iterate_rows(recording: Recording, labels: list[str]) -> Iterator[list[object]]:
    if not recording.segments:
        for time, values in _iterate_samples(recording):
            yield [time, *values]
        return
    for segment, piece in zip(recording.segments, recording.split_segments(), strict=True):
        texts = [_blank_missing(segment.labels.get(name, "")) for name in labels]
        for time, values in _iterate_samples(piece):
            yield [time, *texts, *values]


def _iterate_samples(recording: Recording) -> Iterator[tuple[float, list[object]]]:
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
    time, written = nan, set[int]()
    row: list[object] = [None] * len(channels)
    for index in np.argsort(times, kind="stable").tolist():
        number = int(group_of_sample[index])
        if written and (time != times[index] or number in written):
            yield time, row
            row, written = [None] * len(channels), set()
        time = float(times[index])
        written.add(number)
        for member in groups[number]:
            row[member] = _blank_missing(float(channels[member].values[index_in_group[index]]))
    if written:
        yield time, row


def _blank_missing(value: float | str) -> float | str | None:
    return value if isinstance(value, str) or isfinite(value) else None


def _format_heading(channel: Channel) -> str:
    return channel.name if channel.unit == "1" else f"{channel.name} [{channel.unit}]"
