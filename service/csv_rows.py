"""A recording as CSV, written while it is sent. Numbers come back bit for bit."""

import csv
from collections.abc import Iterator
from io import StringIO
from math import isfinite

import numpy as np

from sysid.data.records import Channel, Recording

BLOCK = 5000


def csv_rows(recording: Recording) -> Iterator[str]:
    """CSV text in blocks: time in s, label columns of segments, one column a channel.

    In a segment the time is the segment's own, so that an upload with ``?segments=`` and the
    label columns gives the same recording. Channels with other times have rows of their own.
    """
    labels = sorted({name for segment in recording.segments for name in segment.labels})
    buffer = StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["t", *labels, *(_heading(channel) for channel in recording.channels)])
    for number, row in enumerate(_rows(recording, labels), 1):
        writer.writerow(row)
        if number % BLOCK == 0:
            yield _taken(buffer)
    yield _taken(buffer)


def _rows(recording: Recording, labels: list[str]) -> Iterator[list[str]]:
    if not recording.segments:
        for time, values in _samples(recording):
            yield [repr(time), *values]
        return
    for segment, piece in zip(recording.segments, recording.pieces(), strict=True):
        texts = [_text(segment.labels.get(name, "")) for name in labels]
        for time, values in _samples(piece):
            yield [repr(time), *texts, *values]


def _samples(recording: Recording) -> Iterator[tuple[float, list[str]]]:
    """Times in their order; what a channel does not have at a time stays empty."""
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
    whose = np.concatenate(
        [np.full(channels[group[0]].times.size, number) for number, group in enumerate(groups)]
    )
    place = np.concatenate([np.arange(channels[group[0]].times.size) for group in groups])
    for index in np.argsort(times, kind="stable").tolist():
        yield float(times[index]), _values(channels, groups[int(whose[index])], int(place[index]))


def _values(channels: tuple[Channel, ...], filled: list[int], place: int) -> list[str]:
    row = [""] * len(channels)
    for index in filled:
        row[index] = _text(float(channels[index].values[place]))
    return row


def _text(value: float | str) -> str:
    if isinstance(value, str):
        return value
    return repr(value) if isfinite(value) else ""


def _heading(channel: Channel) -> str:
    return channel.name if channel.unit == "1" else f"{channel.name} [{channel.unit}]"


def _taken(buffer: StringIO) -> str:
    text = buffer.getvalue()
    buffer.seek(0)
    buffer.truncate()
    return text
