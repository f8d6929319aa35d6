"""Read and write recordings and fitted signals as MCAP files.

Files written by lagid are read by their manifest, others by their schemas. One chunk is one array
of messages.
"""

import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import BinaryIO, Literal, Protocol, cast

import numpy as np

from service.formats.limits import DEFAULT_LIMITS, UploadLimits
from service.formats.mcap.mcap_content import (
    McapChannel,
    McapContent,
    build_no_signal_error,
    read_content,
    sort_columns,
)
from service.formats.mcap.mcap_writer import McapWriter
from service.formats.mcap.topics import (
    DATASET_RECORD,
    TIME_FIELD,
    ChannelEntry,
    Manifest,
    Topic,
    build_manifest,
    group_history_topics,
    group_into_topics,
    group_repeat_topics,
    make_topic,
    parse_manifest,
)
from service.formats.read_options import Clock
from sysid.core.errors import InvalidRecord, UnreadableFile
from sysid.core.types import FloatArray
from sysid.data.records import Channel, History, Record, Recording
from sysid.data.table_rules import find_clock_start


class ByteSink(Protocol):
    """Target of a file: any object that takes bytes."""

    def write(self, data: bytes, /) -> object:
        """Take the next bytes."""
        ...


McapTarget = str | os.PathLike[str] | ByteSink


FitRole = Literal["estimation", "validation"]

RUN_RECORD = "lagid.run"
"""Name of the metadata record of a run's file."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedOutput:
    """One output of one experiment: measured and simulated at the measured times (s).

    `number` counts the experiments of a role from 1.
    """

    role: FitRole
    number: int
    name: str
    unit: str
    times: FloatArray
    measured: FloatArray
    simulated: FloatArray

    @property
    def experiment(self) -> str:
        """Name of the experiment, such as ``estimation 2``."""
        return f"{self.role} {self.number}"


def list_fitted_outputs(
    role: FitRole, records: Sequence[Record], simulated: Sequence[Sequence[FloatArray]]
) -> list[FittedOutput]:
    """List the outputs of records with their simulated values."""
    return [
        FittedOutput(
            role, number, channel.name, channel.unit, channel.times, channel.values, values
        )
        for number, (record, outputs) in enumerate(zip(records, simulated, strict=True), 1)
        for channel, values in zip(record.outputs, outputs, strict=True)
    ]


def write_recording(
    recording: Recording,
    target: McapTarget,
    *,
    metadata: Mapping[str, str] | None = None,
) -> None:
    """Write a recording as an MCAP file.

    The same recording and metadata give the same bytes. Values and times come back bit for bit.
    Samples before the start of the record are stored in separate topics below ``/history``, the
    numbers of pooled repeats below ``/repeats``.

    Parameters
    ----------
    target : path or writable
    metadata : mapping of str to str
        Entries added to the record ``lagid.dataset``: hash of the source, parents, name …

    Raises
    ------
    ValueError
        If the times exceed the range of a file's clock, or a metadata key is reserved. Also if the
        recording exceeds a limit of the reader.
    """
    topics, history = group_into_topics(recording), group_history_topics(recording)
    repeats = group_repeat_topics(recording)
    manifest = build_manifest(recording, topics, metadata or {}, history, repeats)
    _write_file(target, (*topics, *history, *repeats), manifest)


@dataclass(frozen=True, slots=True, eq=False)
class FittedInput:
    """One input of one experiment, as `FittedOutput`."""

    role: FitRole
    number: int
    channel: Channel

    @property
    def experiment(self) -> str:
        """Name of the experiment, such as ``estimation 2``."""
        return f"{self.role} {self.number}"


def list_fitted_inputs(role: FitRole, records: Sequence[Record]) -> list[FittedInput]:
    """List the inputs of records."""
    return [
        FittedInput(role, number, channel)
        for number, record in enumerate(records, 1)
        for channel in record.inputs
    ]


def write_fitted_outputs(
    fits: Sequence[FittedOutput],
    target: McapTarget,
    *,
    inputs: Sequence[FittedInput] = (),
    run: Mapping[str, str] | None = None,
    started_at: datetime | None = None,
) -> None:
    """Write the fitted signals of a run as an MCAP file.

    Topic ``/fit`` has three fields per output: ``<output>`` (simulated), ``<output>_measured`` and
    ``<output>_residual``. Topic ``/inputs`` has a field per input. Further experiments, and signals
    with other times, have topics below them. The topics are those of every run, so that the layout
    of a viewer serves for the next one.

    Parameters
    ----------
    inputs : sequence of FittedInput
        Inputs of the same experiments.
    run : mapping of str to str
        Content of the metadata record ``lagid.run``: identifiers, model, parameters, origin.
    started_at : datetime, optional
        Time 0 s on the clock that recorded.
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
        channels = [channel for fit in group for channel in _to_channels(fit, started_at)]
        names = [
            f"{fit.name}{suffix}" for fit in group for suffix in ("", "_measured", "_residual")
        ]
        path = "/fit" if number == 0 else f"/fit/{number + 1}"
        topics.append(make_topic(path, channels, names))
    topics += _build_input_topics(inputs, started_at)
    recording = Recording(
        tuple(channel for topic in topics for channel in topic.channels), started_at=started_at
    )
    _write_file(target, topics, build_manifest(recording, topics, {}), run)


def _build_input_topics(inputs: Sequence[FittedInput], started_at: datetime | None) -> list[Topic]:
    """Build the topics of inputs, each of one experiment and of equal times."""
    topics: list[Topic] = []
    for name, group in groupby(inputs, key=lambda one: one.experiment):
        channels = tuple(
            Channel(
                f"{name}/{one.channel.name}/input",
                one.channel.times,
                one.channel.values,
                one.channel.unit,
                one.channel.hold,
                started_at=started_at,
            )
            for one in group
        )
        for topic in group_into_topics(Recording(channels)):
            path = "/inputs" if not topics else f"/inputs/{len(topics) + 1}"
            fields = [channel.name.split("/", 2)[1] for channel in topic.channels]
            topics.append(make_topic(path, topic.channels, fields))
    return topics


def _to_channels(fit: FittedOutput, started_at: datetime | None) -> tuple[Channel, ...]:
    """Return the channels of one output; '/' separates experiment, output and signal."""
    prefix = f"{fit.experiment}/{fit.name}"
    values = (
        ("simulated", fit.simulated),
        ("measured", fit.measured),
        ("residual", fit.measured - fit.simulated),
    )
    return tuple(
        Channel(f"{prefix}/{signal}", fit.times, data, fit.unit, started_at=started_at)
        for signal, data in values
    )


def _write_file(
    target: McapTarget,
    topics: Sequence[Topic],
    manifest: Mapping[str, str],
    run: Mapping[str, str] | None = None,
) -> None:
    if isinstance(target, str | os.PathLike):
        with Path(target).open("wb") as stream:
            _write_file(stream, topics, manifest, run)
        return
    file = McapWriter(target.write)
    file.add_metadata(DATASET_RECORD, manifest)
    if run is not None:
        file.add_metadata(RUN_RECORD, run)
    numbers = [file.add_topic(topic.path, topic.all_fields) for topic in topics]
    for number, topic in zip(numbers, topics, strict=True):
        file.add_samples(number, topic.log_times, topic.columns)
    file.finish_file()


EPOCH_THRESHOLD_NS = 10**17
"""Log times (ns) from this on (three years) are clock times, counted from the first one."""

_NO_TOPIC: tuple[FloatArray, Mapping[str, FloatArray]] = (np.empty(0), {})
_TopicColumns = Mapping[str, tuple[FloatArray, Mapping[str, FloatArray]]]
"""Times and columns of every topic."""

McapSource = str | os.PathLike[str] | bytes | BinaryIO


def read_mcap(source: McapSource, limits: UploadLimits = DEFAULT_LIMITS) -> Recording:
    """Read a recording from a whole MCAP file (path, content, or seekable stream).

    Raises
    ------
    UnreadableFile
        If the file is damaged, cut off, too large, or holds no signal.
    """
    with _open_binary(source) as (binary, size):
        content = read_content(binary, size, limits)
    if content.cut is not None:
        raise content.cut
    return _build_recording(content, limits, "log")[0]


def read_fitted_outputs(
    source: McapSource, limits: UploadLimits = DEFAULT_LIMITS
) -> tuple[FittedOutput, ...]:
    """Read a file of `write_fitted_outputs`.

    Raises
    ------
    UnreadableFile
        If the file is damaged or of another kind.
    """
    recording = read_mcap(source, limits)
    fits = []
    for channel in recording.channels:
        prefix, _, signal = channel.name.rpartition("/")
        if signal != "simulated":
            continue
        experiment, _, name = prefix.partition("/")
        measured = recording.channel(f"{prefix}/measured").values
        role, _, number = experiment.partition(" ")
        fits.append(
            FittedOutput(
                cast(FitRole, role),
                int(number),
                name,
                channel.unit,
                channel.times,
                measured,
                channel.values,
            )
        )
    if not fits:
        raise UnreadableFile("the file holds no fitted signals")
    return tuple(fits)


def read_mcap_with_notes(
    source: McapSource, limits: UploadLimits, clock: Clock = "log"
) -> tuple[Recording, tuple[str, ...]]:
    """Read a recording, with notes on what was skipped or changed.

    Of a file that is cut off, what is whole is read.

    Raises
    ------
    UnreadableFile
        If the file is damaged, too large, or holds no signal, or its messages lack the clock.
    """
    with _open_binary(source) as (binary, size):
        content = read_content(binary, size, limits)
    recording, notes = _build_recording(content, limits, clock)
    if content.cut is not None:
        what, last = content.cut.what.partition("; it is truncated")[0], recording.stop
        notes = (*notes, f"{what}. What is whole was read, up to {last:.6g} s")
    return recording, notes


def _build_recording(
    content: McapContent, limits: UploadLimits, clock: Clock
) -> tuple[Recording, tuple[str, ...]]:
    metadata = content.metadata.get(DATASET_RECORD)
    if metadata is None:
        return _build_foreign_recording(content, limits, clock)
    return _build_own_recording(content, metadata)


@contextmanager
def _open_binary(source: McapSource) -> Iterator[tuple[BinaryIO, int]]:
    if isinstance(source, bytes):
        yield io.BytesIO(source), len(source)
    elif isinstance(source, str | os.PathLike):
        with Path(source).open("rb") as stream:
            yield stream, os.fstat(stream.fileno()).st_size
    else:
        size = source.seek(0, io.SEEK_END)
        source.seek(0)
        yield source, size


def _build_own_recording(
    content: McapContent, metadata: Mapping[str, str]
) -> tuple[Recording, tuple[str, ...]]:
    try:
        manifest = parse_manifest(metadata)
    except ValueError as error:
        raise UnreadableFile(
            f"the metadata record {DATASET_RECORD!r} cannot be used: {error}"
        ) from None
    topics: dict[str, tuple[FloatArray, dict[str, FloatArray]]] = {}
    for source in content.channels.values():
        if source.topic in manifest.clocks:
            topics[source.topic] = _decode_topic(source, manifest)
    whole, lost = list(manifest.channels), list[str]()
    if content.cut is not None:
        whole = [entry for entry in whole if entry.field in topics.get(entry.topic, _NO_TOPIC)[1]]
        lost = [entry.name for entry in manifest.channels if entry not in whole]
        if not whole:
            raise content.cut
    channels = tuple(
        _attach_repeats(
            _attach_history(_build_channel(entry, topics, manifest.time_unit), manifest, topics),
            manifest,
            topics,
        )
        for entry in whole
    )
    notes = (f"no samples are left of {', '.join(lost)}",) if lost else ()
    return Recording(channels, manifest.segments, manifest.started_at), notes


def _decode_topic(
    source: McapChannel, manifest: Manifest
) -> tuple[FloatArray, dict[str, FloatArray]]:
    log_times, columns = sort_columns(source)[:2]
    times = manifest.clocks[source.topic].to_times(log_times, columns.get(TIME_FIELD))
    if not np.all(np.isfinite(times)) or np.any(np.diff(times) < 0):
        raise UnreadableFile(f"the times of topic {source.topic!r} decrease or are not finite")
    return times, columns


def _build_channel(entry: ChannelEntry, topics: _TopicColumns, time_unit: str) -> Channel:
    times, values = _find_column(f"channel {entry.name!r}", entry.topic, entry.field, topics)
    return Channel(entry.name, times, values, entry.unit, entry.hold, time_unit=time_unit)


def _attach_history(channel: Channel, manifest: Manifest, topics: _TopicColumns) -> Channel:
    if channel.name not in manifest.history:
        return channel
    topic, field = manifest.history[channel.name]
    history = History(*_find_column(f"the history of {channel.name!r}", topic, field, topics))
    try:
        return replace(channel, history=history)
    except InvalidRecord as error:
        raise UnreadableFile(str(error)) from None


def _attach_repeats(channel: Channel, manifest: Manifest, topics: _TopicColumns) -> Channel:
    if channel.name not in manifest.repeats:
        return channel
    topic, field = manifest.repeats[channel.name]
    _, repeats = _find_column(f"the repeats of {channel.name!r}", topic, field, topics)
    try:
        return replace(channel, repeats=repeats)
    except InvalidRecord as error:
        raise UnreadableFile(str(error)) from None


def _find_column(
    what: str, topic: str, field: str, topics: _TopicColumns
) -> tuple[FloatArray, FloatArray]:
    times, columns = topics.get(topic, (np.empty(0), {}))
    if field not in columns:
        raise UnreadableFile(
            f"{what} refers to field {field!r} of topic {topic!r}, which the file does not have"
        )
    return times, columns[field]


def _build_foreign_recording(
    content: McapContent, limits: UploadLimits, clock: Clock
) -> tuple[Recording, tuple[str, ...]]:
    topics = [(source, sort_columns(source, clock)) for source in content.channels.values()]
    usable = [(source, messages) for source, messages in topics if messages.columns]
    if not usable:
        raise build_no_signal_error(content)
    notes = [
        f"topic {source.topic!r} is skipped: {source.refusal}"
        for source in content.channels.values()
        if source.refusal
    ]
    notes += [
        f"topic {source.topic!r} was sorted: it was not in order of time"
        for source, messages in usable
        if not messages.was_sorted
    ]
    notes += [
        _describe_delay(source.topic, name, delays)
        for source, messages in usable
        for name, delays in messages.delays.items()
    ]
    first = min(int(messages.times[0]) for _, messages in usable)
    start = first if first >= EPOCH_THRESHOLD_NS else 0
    if start:
        notes.append(f"times are counted from the first message, at {start} ns of the file's clock")
    channels: dict[str, Channel] = {}
    for source, messages in usable:
        times = (messages.times - np.uint64(start)).astype(np.float64) / 1e9
        for field, values in messages.columns.items():
            name = _choose_free_name(source.topic, field, alone=len(usable) == 1, taken=channels)
            channels[name] = Channel(name, times, values)
    if len(channels) > limits.channels:
        raise UnreadableFile(
            f"the file has {len(channels)} signals; at most {limits.channels} are read"
        )
    moment = find_clock_start(start / 1e9)
    return Recording(tuple(channels.values()), started_at=moment), tuple(notes)


def _describe_delay(topic: str, clock: Clock, delays: FloatArray) -> str:
    """Describe by how much the log comes after another clock of the same messages."""
    least, middle, most = (float(x) / 1e6 for x in np.quantile(delays, (0.0, 0.5, 1.0)))
    word = {"publish": "publish time", "stamp": "stamp in the header"}.get(clock, clock)
    return (
        f"topic {topic!r}: the log time comes {middle:.4g} ms after the {word} in the median, "
        f"{least:.4g} to {most:.4g} ms. The clock is chosen by clock={clock}"
    )


def _choose_free_name(topic: str, field: str, *, alone: bool, taken: Mapping[str, object]) -> str:
    wanted = field if alone else f"{topic.strip('/')}.{field}"
    number, name = 2, wanted
    while name in taken:
        name, number = f"{wanted}_{number}", number + 1
    return name
