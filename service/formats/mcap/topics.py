"""Layout of a recording in an MCAP file: topics, fields, clocks, and the manifest that names them.

The clock of a file counts whole nanoseconds, and times must come back bit for bit. Three rules do
this. Rule ``nanoseconds``: most times are printed with nine decimals or fewer, so the clock is
exact. Rule ``regular``: for computed times ``k·T`` the period is stored. Rule ``field``: otherwise
each message carries its time in a separate field.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from math import floor
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from service.formats.mcap.mcap_messages import make_identifiers
from sysid.core.types import FloatArray
from sysid.data.records import HOLDS, Channel, Recording, Segment

ClockRule = Literal["nanoseconds", "regular", "field"]
Nanoseconds = NDArray[np.uint64]
LATEST_NS = 2**63
LATEST_S = LATEST_NS / 1e9
TIME_FIELD = "time_s"
_YEAR_1970 = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class TopicClock:
    """How the times of one topic are recovered from its file.

    Attributes
    ----------
    rule : {"nanoseconds", "regular", "field"}
    epoch : int
        Time (s) of the file's nanosecond `origin`; not 0 only if times are negative.
    origin : int
        Moment of the epoch in ns since 1970, so that viewers show the day; 0 if it is not known.
    start, period : float
        First time and sampling period, for ``regular``.
    """

    rule: ClockRule
    epoch: int = 0
    start: float = 0.0
    period: float = 0.0
    origin: int = 0

    def to_times(self, log_times: Nanoseconds, field: FloatArray | None) -> FloatArray:
        """Return the times in s."""
        if self.rule == "field" and field is not None:
            return field
        if self.rule == "regular":
            grid: FloatArray = self.start + self.period * np.arange(
                log_times.size, dtype=np.float64
            )
            return grid
        return _to_seconds(log_times, self.epoch, self.origin)

    def to_dict(self) -> dict[str, object]:
        """Return the clock as an entry of the file's metadata."""
        return asdict(self)

    @classmethod
    def from_dict(cls, entry: Mapping[str, object]) -> "TopicClock":
        """Return the inverse of `to_dict`; ValueError for an invalid entry."""
        rule, epoch = entry.get("rule"), entry.get("epoch")
        start, period, origin = entry.get("start"), entry.get("period"), entry.get("origin", 0)
        if (
            rule not in ("nanoseconds", "regular", "field")
            or not type(epoch) is type(origin) is int
        ):
            raise ValueError(f"{entry!r} is not a clock rule")
        if not isinstance(start, int | float) or not isinstance(period, int | float):
            raise ValueError(f"{entry!r} is not a clock rule")
        if not 0 <= origin < LATEST_NS:
            raise ValueError(f"{entry!r} exceeds the range of a file's clock")
        if not (-LATEST_S < epoch <= 0 and abs(start) < LATEST_S and 0 <= period < LATEST_S):
            raise ValueError(f"{entry!r} exceeds the range of a file's clock")
        return cls(rule, epoch, float(start), float(period), origin)


def choose_clock(
    times: FloatArray, started_at: datetime | None = None
) -> tuple[TopicClock, Nanoseconds]:
    """Choose the clock of non-decreasing times (s), and return the times on it.

    With the moment of time 0 s the file's clock counts from 1970; without a zone it is taken for
    UTC, so that a viewer shows what the logger's clock showed.

    Raises
    ------
    ValueError
        If the times exceed the range of a file's clock (292 years).
    """
    origin = _find_origin(started_at, times)
    epoch = 0 if origin else min(0, floor(float(times[0])))
    if epoch <= -LATEST_S or float(times[-1]) - epoch + origin / 1e9 >= LATEST_S:
        raise ValueError(f"times up to {float(times[-1])!r} s do not fit into 63 bits of ns")
    log_times = (np.rint((times - epoch) * 1e9).astype(np.int64) + origin).astype(np.uint64)
    if np.array_equal(_to_seconds(log_times, epoch, origin), times):
        return TopicClock("nanoseconds", epoch, origin=origin), log_times
    for period in _propose_periods(times):
        clock = TopicClock("regular", epoch, float(times[0]), period, origin)
        if np.array_equal(clock.to_times(log_times, None), times):
            return clock, log_times
    return TopicClock("field", epoch, origin=origin), log_times


def _find_origin(started_at: datetime | None, times: FloatArray) -> int:
    """Find the ns since 1970 of time 0 s; 0 if it is not known, or some times are earlier."""
    if started_at is None:
        return 0
    moment = started_at if started_at.tzinfo else started_at.replace(tzinfo=UTC)
    origin = (moment - _YEAR_1970) // timedelta(microseconds=1) * 1000
    return origin if origin + float(times[0]) * 1e9 > 0 else 0


def _to_seconds(log_times: Nanoseconds, epoch: int, origin: int) -> FloatArray:
    # A quotient of whole numbers is correctly rounded, like the decimal number that it equals.
    signed = log_times.astype(np.int64) + (epoch * 10**9 - origin)
    return np.asarray(signed / 1e9, dtype=np.float64)


def _propose_periods(times: FloatArray) -> Iterator[float]:
    if times.size > 1:
        mean = float(times[-1] - times[0]) / (times.size - 1)
        yield float(times[1] - times[0])
        for digits in range(3, 18):
            yield float(f"{mean:.{digits}g}")


DATASET_RECORD = "lagid.dataset"
"""Name of the metadata record that describes a file written by lagid."""

FORMAT_VERSION = "1"
RESERVED_KEYS = (
    "format",
    "sample_time",
    "channels",
    "topics",
    "segments",
    "history",
    "repeats",
    "started_at",
    "time_unit",
)


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """Channels that share their times: one MCAP channel, one protobuf field for each.

    `exact_times` holds the times themselves if the file's clock cannot represent them exactly.
    """

    path: str
    channels: tuple[Channel, ...]
    fields: tuple[str, ...]
    clock: TopicClock
    log_times: Nanoseconds
    exact_times: tuple[FloatArray, ...] = ()

    @property
    def columns(self) -> tuple[FloatArray, ...]:
        """The values of each of `all_fields`."""
        return (*(channel.values for channel in self.channels), *self.exact_times)

    @property
    def all_fields(self) -> tuple[str, ...]:
        """Names of the message's fields."""
        return (*self.fields, TIME_FIELD) if self.exact_times else self.fields


def make_topic(path: str, channels: Sequence[Channel], names: Sequence[str]) -> Topic:
    """Make the topic of channels with equal times; `names` are the wanted names of its fields."""
    times = channels[0].times
    clock, log_times = choose_clock(times, channels[0].started_at)
    extra = (times,) if clock.rule == "field" else ()
    fields = make_identifiers((TIME_FIELD, *names))[1:]
    return Topic(path, tuple(channels), fields, clock, log_times, extra)


def group_into_topics(recording: Recording, root: str = "/signals") -> tuple[Topic, ...]:
    """Group the channels of a recording into topics; the first topic is `root`."""
    groups: list[list[Channel]] = []
    for channel in recording.channels:
        for group in groups:
            if _have_same_times(group[0], channel):
                group.append(channel)
                break
        else:
            groups.append([channel])
    paths = [root, *(f"{root}/{name}" for name in make_identifiers(g[0].name for g in groups[1:]))]
    return tuple(
        make_topic(path, group, [channel.name for channel in group])
        for path, group in zip(paths, groups, strict=True)
    )


def group_history_topics(recording: Recording) -> tuple[Topic, ...]:
    """Group the samples before the start of the record into topics; empty if there are none."""
    channels = tuple(
        replace(
            channel,
            times=channel.history.times,
            values=channel.history.values,
            history=None,
            repeats=None,
        )
        for channel in recording.channels
        if channel.history is not None and channel.history.times.size
    )
    return group_into_topics(Recording(channels), "/history") if channels else ()


def group_repeat_topics(recording: Recording) -> tuple[Topic, ...]:
    """Group the numbers of the repeats of pooled samples into topics; empty if there are none."""
    channels = tuple(
        replace(channel, values=channel.repeats, unit="1", history=None, repeats=None)
        for channel in recording.channels
        if channel.repeats is not None
    )
    return group_into_topics(Recording(channels), "/repeats") if channels else ()


def _have_same_times(a: Channel, b: Channel) -> bool:
    return a.times is b.times or np.array_equal(a.times, b.times)


def build_manifest(
    recording: Recording,
    topics: Sequence[Topic],
    metadata: Mapping[str, str],
    history: Sequence[Topic] = (),
    repeats: Sequence[Topic] = (),
) -> dict[str, str]:
    """Build the content of the record `DATASET_RECORD`: all that the messages do not say.

    Raises
    ------
    ValueError
        If `metadata` uses a reserved key.
    """
    if taken := sorted(set(metadata) & set(RESERVED_KEYS)):
        raise ValueError(f"the metadata keys {', '.join(taken)} are reserved")
    order = [channel.name for channel in recording.channels]
    entries = [
        {"name": c.name, "unit": c.unit, "hold": c.hold, "topic": topic.path, "field": field}
        for topic in topics
        for c, field in zip(topic.channels, topic.fields, strict=True)
    ]
    entries.sort(key=lambda entry: order.index(entry["name"]))
    clocks = {topic.path: topic.clock.to_dict() for topic in (*topics, *history, *repeats)}
    sampling, start = recording.sampling, recording.started_at
    time_unit = recording.channels[0].time_unit
    return {
        "format": FORMAT_VERSION,
        "sample_time": f"{sampling.period:.12g}" if sampling.is_regular else "",
        "channels": json.dumps(entries),
        "topics": json.dumps(clocks),
        "segments": json.dumps([asdict(segment) for segment in recording.segments]),
        "history": json.dumps(_list_places(history)),
        **({"repeats": json.dumps(_list_places(repeats))} if repeats else {}),
        **({} if start is None else {"started_at": start.isoformat()}),
        **({} if time_unit == "s" else {"time_unit": time_unit}),
        **metadata,
    }


def _list_places(topics: Sequence[Topic]) -> dict[str, dict[str, str]]:
    """List topic and field of each channel."""
    return {
        channel.name: {"topic": topic.path, "field": field}
        for topic in topics
        for channel, field in zip(topic.channels, topic.fields, strict=True)
    }


@dataclass(frozen=True, slots=True)
class ChannelEntry:
    """Position of one channel of the recording in the file."""

    name: str
    unit: str
    hold: Any
    topic: str
    field: str


@dataclass(frozen=True, slots=True)
class Manifest:
    """The checked record `DATASET_RECORD`.

    `history` and `repeats` have topic and field of what belongs to a channel.
    """

    channels: tuple[ChannelEntry, ...]
    clocks: Mapping[str, TopicClock]
    segments: tuple[Segment, ...]
    history: Mapping[str, tuple[str, str]]
    repeats: Mapping[str, tuple[str, str]]
    started_at: datetime | None = None
    time_unit: str = "s"


def parse_manifest(metadata: Mapping[str, str]) -> Manifest:
    """Check the content of a record `DATASET_RECORD`.

    Raises
    ------
    ValueError
        If `build_manifest` could not have written it; the file may come from anyone.
    """
    try:
        if metadata["format"] != FORMAT_VERSION:
            raise ValueError(
                f"its format is {metadata['format']!r}; this program reads {FORMAT_VERSION!r}"
            )
        channels = tuple(_parse_channel(entry) for entry in json.loads(metadata["channels"]))
        clocks = json.loads(metadata["topics"])
        segments = tuple(_parse_segment(entry) for entry in json.loads(metadata["segments"]))
        history, repeats = (
            {
                name: (entry["topic"], entry["field"])
                for name, entry in json.loads(metadata.get(key, "{}")).items()
            }
            for key in ("history", "repeats")
        )
        manifest = Manifest(
            channels,
            {path: TopicClock.from_dict(entry) for path, entry in clocks.items()},
            segments,
            history,
            repeats,
            datetime.fromisoformat(metadata["started_at"]) if "started_at" in metadata else None,
            metadata.get("time_unit", "s"),
        )
    except (KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from None
    names = {channel.name for channel in channels}
    if not names or len(names) != len(channels):
        raise ValueError("its channels have no names, or the same name twice")
    if any(channel.topic not in manifest.clocks for channel in channels):
        raise ValueError("a channel names a topic that is not listed")
    for what, places in (("history", history), ("repeats", repeats)):
        for name, (topic, field) in places.items():
            is_text = isinstance(topic, str) and isinstance(field, str)
            if name not in names or not is_text or topic not in manifest.clocks:
                raise ValueError(f"the {what} of {name!r} has no channel, or is in no topic")
    return manifest


def _parse_channel(entry: Mapping[str, Any]) -> ChannelEntry:
    channel = ChannelEntry(**entry)
    texts = (channel.name, channel.unit, channel.topic, channel.field)
    if not all(isinstance(text, str) for text in texts) or channel.hold not in HOLDS:
        raise ValueError(f"{entry!r} is not the entry of a channel")
    return channel


def _parse_segment(entry: Mapping[str, Any]) -> Segment:
    segment = Segment(**entry)
    numbers = (segment.start, segment.stop, segment.origin)
    plain = all(isinstance(number, int | float) and np.isfinite(number) for number in numbers)
    labels = isinstance(segment.labels, dict) and all(
        isinstance(label, (str, *get_args(int | float))) for label in segment.labels.values()
    )
    if not plain or not labels or segment.start > segment.stop:
        raise ValueError(f"{entry!r} is not a segment")
    return segment
