"""Recordings and fitted signals as MCAP files, one chunk as one array of messages."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from service.signals.mcap_file import McapFile
from service.signals.topics import (
    DATASET,
    Topic,
    history_topics_of,
    make_topic,
    manifest_of,
    topics_of,
)
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording


class Writable(Protocol):
    """What a file is written to: anything that takes bytes."""

    def write(self, data: bytes, /) -> object:
        """Take the next bytes."""
        ...


Target = str | os.PathLike[str] | Writable


@dataclass(frozen=True, slots=True, eq=False)
class FittedOutput:
    """One output of one experiment: measured and simulated at the measured times (s)."""

    experiment: str
    name: str
    unit: str
    times: FloatArray
    measured: FloatArray
    simulated: FloatArray


def write_recording(
    recording: Recording,
    target: Target,
    *,
    metadata: Mapping[str, str] | None = None,
    attachments: Mapping[str, bytes] | None = None,
) -> None:
    """Write a recording as an MCAP file.

    The same recording and metadata give the same bytes. Values and times come back bit for bit.
    What was recorded before the first samples stands in topics of its own, below ``/history``.

    Parameters
    ----------
    target : path or writable
    metadata : mapping of str to str
        Added to the record ``lagid.dataset``: hash of the source, parents, name …
    attachments : mapping of str to bytes
        JSON documents, such as the model or a calibration, by name.

    Raises
    ------
    ValueError
        If the times do not fit into a file's clock, or a metadata key is the file's own.
    """
    topics, history = topics_of(recording), history_topics_of(recording)
    manifest = manifest_of(recording, topics, metadata or {}, history)
    _write(target, (*topics, *history), manifest, attachments or {})


def write_fit(
    run: str,
    fits: Sequence[FittedOutput],
    target: Target,
    *,
    metadata: Mapping[str, str] | None = None,
    attachments: Mapping[str, bytes] | None = None,
) -> None:
    """Write what a run identified as an MCAP file.

    Topic ``/fit/<run>`` has for each output the fields ``<output>`` (simulated),
    ``<output>_measured`` and ``<output>_residual``; further experiments, and outputs with other
    times, have topics below it.
    """
    groups: list[list[FittedOutput]] = []
    for fit in fits:
        last = groups[-1][0] if groups else None
        if last and last.experiment == fit.experiment and last.times is fit.times:
            groups[-1].append(fit)
        else:
            groups.append([fit])
    topics = []
    for number, group in enumerate(groups):
        channels = [channel for fit in group for channel in _channels(fit)]
        names = [
            f"{fit.name}{suffix}" for fit in group for suffix in ("", "_measured", "_residual")
        ]
        path = f"/fit/{run}" if number == 0 else f"/fit/{run}/{number + 1}"
        topics.append(make_topic(path, channels, names))
    recording = Recording(tuple(channel for topic in topics for channel in topic.channels))
    _write(target, topics, manifest_of(recording, topics, metadata or {}), attachments or {})


def _channels(fit: FittedOutput) -> tuple[Channel, ...]:
    """Channels of one output; '/' separates experiment, output and what it is."""
    named = f"{fit.experiment}/{fit.name}"
    values = (
        ("simulated", fit.simulated),
        ("measured", fit.measured),
        ("residual", fit.measured - fit.simulated),
    )
    return tuple(Channel(f"{named}/{what}", fit.times, data, fit.unit) for what, data in values)


def _write(
    target: Target,
    topics: Sequence[Topic],
    manifest: Mapping[str, str],
    attachments: Mapping[str, bytes],
) -> None:
    if isinstance(target, str | os.PathLike):
        with Path(target).open("wb") as stream:
            _write(stream, topics, manifest, attachments)
        return
    file = McapFile(target.write)
    file.add_metadata(DATASET, manifest)
    for name, content in attachments.items():
        file.add_attachment(name, "application/json", content)
    numbers = [file.add_topic(topic.path, topic.all_fields) for topic in topics]
    for number, topic in zip(numbers, topics, strict=True):
        file.add_samples(number, topic.log_times, topic.columns)
    file.finish()
