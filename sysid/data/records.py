"""Recordings: channels on their own times, segments, and records for a model."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from sysid.core.errors import InvalidRecord, suggest_name
from sysid.core.findings import Finding
from sysid.core.text import append_unit
from sysid.core.types import BoolArray, FloatArray
from sysid.data.foreign_tables import (
    Column,
    Labelled,
    describe_object,
    find_first_start,
    is_labelled,
    measure_distance,
    read_columns,
    read_numbers,
    read_times,
    split_series,
    to_frame,
)
from sysid.data.holds import HOLDS as HOLDS
from sysid.data.holds import Hold as Hold
from sysid.data.holds import HoldChoice, choose_hold
from sysid.data.holds import HoldSetting as HoldSetting
from sysid.data.table_rules import TimeAxis
from sysid.data.value_checks import find_infinite_value

REGULARITY_TOLERANCE = 1e-2
"""Largest deviation of regular times from a uniform grid, as a part of the period.

Files print times with few digits. With 10 µs, 610.35 Hz deviates by 0.3 % of a period.
"""


_PERIOD_TOLERANCE = 1e-6  # relative difference of the periods of one clock


class Sampling(NamedTuple):
    """Sampling of a signal; an irregular one has its median distance as `period` (s)."""

    samples: int
    period: float
    is_regular: bool

    def __str__(self) -> str:
        if self.samples < 2:
            return "one sample"
        kind = "every" if self.is_regular else "irregular, median"
        return f"{self.samples} samples, {kind} {self.period:.6g} s"


def measure_sampling(times: FloatArray, within: float = REGULARITY_TOLERANCE) -> Sampling:
    """Measure the sampling of times (s); `within` is the tolerance in parts of a period."""
    if times.size < 2:
        return Sampling(times.size, float("nan"), is_regular=False)
    period = float(times[-1] - times[0]) / (times.size - 1)
    grid = times[0] + period * np.arange(times.size)
    if period > 0 and float(np.max(np.abs(times - grid))) <= within * period:
        return Sampling(times.size, period, is_regular=True)
    return Sampling(times.size, float(np.median(np.diff(times))), is_regular=False)


class History(NamedTuple):
    """Samples before a channel's first: times (s, not decreasing) and values.

    Examples
    --------
    >>> Channel("u", [0, 1], [2, 3], history=History([-2, -1], [1, 1])).total_samples
    4
    """

    times: FloatArray
    values: FloatArray


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Channel:
    """One measured signal on its own times.

    Times and values may be lists or arrays of any library, of shape (N,) or (N, 1); they are kept
    as arrays of float64. ``Channel(name, series)`` takes both from a series of pandas or xarray.
    Dates become seconds from the first one.

    Attributes
    ----------
    name, unit : str
    times : FloatArray, shape (N,)
        Seconds from the start of the recording, not decreasing. Samples pooled from several
        repeats may share a time.
    values : FloatArray, shape (N,)
        In `unit`; ``nan`` is a missing value.
    hold : {"auto", "zero", "first", "band-limited", "mean", "mean-after"}
        Behaviour of an input between its samples; ``auto``: chosen by its values. ``mean``: a value
        is the mean of the period that ends at its time, of an output too.
    history : History or None
        Samples recorded before the first one. Only delayed inputs read it: simulation and
        comparison begin at the first sample. None: not recorded; the first value is assumed for
        all earlier times.
    repeats : FloatArray or None, shape (N,)
        Number of the repeat that each sample was pooled from. None: there are no repeats.
    started_at : datetime or None
        Moment of time 0 s; the first date if the times were dates. A `Record` or a `Recording`
        keeps the distance of channels that have one.
    time_unit : str
        Unit in which the source had the times, such as ``min``; estimates are shown in it too.

    Raises
    ------
    InvalidRecord
        If the arrays hold no numbers, differ in length or are empty, or the times decrease or are
        not finite. The same holds for the history.

    Examples
    --------
    >>> Channel("P1", [0.0, 0.1, 0.2], [1.0, 1.2, 1.1], unit="bar")
    Channel 'P1' [bar]: 3 samples, every 0.1 s, from 0 to 0.2 s, values from 1 to 1.2
    """

    name: str
    times: FloatArray
    values: FloatArray = field(default=None)  # type: ignore[arg-type]  # of a series: in `times`
    unit: str = "1"
    hold: HoldSetting = "auto"
    history: History | None = None
    started_at: datetime | None = None
    repeats: FloatArray | None = None
    time_unit: str = "s"
    _choice: HoldChoice | None = field(default=None, init=False, repr=False)

    if TYPE_CHECKING:

        def __init__(
            self,
            name: str,
            times: ArrayLike | Labelled,
            values: ArrayLike | None = None,
            unit: str = "1",
            hold: HoldSetting = "auto",
            history: History | None = None,
            started_at: datetime | None = None,
            repeats: FloatArray | None = None,
            time_unit: str = "s",
        ) -> None: ...

    def __post_init__(self) -> None:
        self._read_arrays()
        if self.times.ndim != 1 or self.times.shape != self.values.shape or self.times.size == 0:
            raise InvalidRecord(
                f"channel {self.name!r} has times of shape {self.times.shape} and values of shape "
                f"{self.values.shape}; need one-dimensional arrays of equal length, not empty"
            )
        self._check_times()
        if self.history is not None:
            self._check_history(self.history)
        if self.repeats is not None and self.repeats.shape != self.times.shape:
            raise InvalidRecord(
                f"channel {self.name!r} has repeats of shape {self.repeats.shape} for times of "
                f"shape {self.times.shape}; need one number for each sample, or None"
            )

    def __repr__(self) -> str:
        unit = "" if self.unit == "1" else f" [{self.unit}]"
        return f"Channel {self.name!r}{unit}: {_describe_samples(self)}"

    def _read_arrays(self) -> None:
        """Read times and values of any kind, once; arrays of float64 are kept as they are."""
        name: object = self.name
        if not isinstance(name, str):
            raise InvalidRecord(f"a channel has the name {name!r}; need a text")
        owner, times, unit = f"channel {self.name!r}", self.times, None
        values: Any = self.values
        if values is None:
            axis, values, unit = split_series(times, owner)
        else:
            axis = read_times(times, f"the times of {owner}")
        object.__setattr__(self, "times", axis.seconds)
        object.__setattr__(self, "values", read_numbers(values, owner))
        if axis.started_at is not None:
            object.__setattr__(self, "started_at", axis.started_at)
        if unit is not None and self.unit == "1":
            object.__setattr__(self, "unit", unit)
        if self.history is not None:
            before, earlier = self.history
            history = History(
                read_numbers(before, f"the history of {owner}"),
                read_numbers(earlier, f"the history of {owner}"),
            )
            object.__setattr__(self, "history", history)

    def _check_times(self) -> None:
        times, owner = self.times, f"the times of channel {self.name!r}"
        infinite = np.flatnonzero(~np.isfinite(times))
        if infinite.size:
            index = infinite[0]
            raise InvalidRecord(f"{owner} are not finite: sample {index + 1} is at {times[index]}")
        backward = np.flatnonzero(np.diff(times) < 0)
        if backward.size:
            index = backward[0]
            raise InvalidRecord(
                f"{owner} decrease: sample {index + 1} is at {times[index]:g} s, the next at "
                f"{times[index + 1]:g} s. Sort the samples by time"
            )

    def _check_history(self, history: History) -> None:
        before, values = history
        if before.ndim != 1 or before.shape != values.shape or before.size == 0:
            raise InvalidRecord(
                f"the history of channel {self.name!r} has times of shape {before.shape} and "
                f"values of shape {values.shape}; need one-dimensional arrays of equal length, "
                "not empty, or None"
            )
        times = np.append(before, self.times[0])
        if np.any(np.diff(times) < 0) or not np.all(np.isfinite(times)):
            raise InvalidRecord(
                f"the history of channel {self.name!r} does not end before its first sample, or "
                "its times decrease or are not finite"
            )

    @property
    def hold_choice(self) -> HoldChoice:
        """The hold that suits the values, and why; history and samples count."""
        if self._choice is None:
            object.__setattr__(self, "_choice", choose_hold(self.history_and_samples.values))
        assert self._choice is not None
        return self._choice

    @property
    def effective_hold(self) -> Hold:
        """The hold that was given, or the one chosen by the values."""
        return self.hold_choice.hold if self.hold == "auto" else self.hold

    @property
    def acting(self) -> "Channel":
        """The signal that acts on a plant: of means, values that are held over their periods.

        Raises
        ------
        InvalidRecord
            If values are means of the periods before them, and their times are irregular.
        """
        hold = self.effective_hold
        if hold == "mean-after":
            return replace(self, hold="zero")
        if hold != "mean":
            return self
        stamps = self.history_and_samples.times
        begins = np.append(stamps[0] - self.read_period(), stamps[:-1])
        first, history = begins.size - self.times.size, self.history
        if history is not None:
            history = history._replace(times=begins[:first])
        return replace(self, times=begins[first:], history=history, hold="zero")

    def read_period(self) -> float:
        """Return the period (s) that values are means of.

        Raises
        ------
        InvalidRecord
            If the times are irregular.
        """
        if not self.sampling.is_regular:
            raise InvalidRecord(
                f"channel {self.name!r} has means (hold '{self.hold}'), but its times are "
                f"irregular: {self.sampling}. What a mean covers is not known. Resample it first, "
                "or choose another hold"
            )
        return self.sampling.period

    @property
    def history_and_samples(self) -> "Channel":
        """Channel with the history joined to the samples."""
        if self.history is None:
            return self
        times, values = (
            np.concatenate(pair)
            for pair in zip(self.history, (self.times, self.values), strict=True)
        )
        return replace(self, times=times, values=values, history=None, repeats=None)

    @property
    def sampling(self) -> Sampling:
        """Sampling of this channel."""
        return measure_sampling(self.times)

    @property
    def total_samples(self) -> int:
        """Number of samples, including the history."""
        return self.times.size + (0 if self.history is None else self.history.times.size)

    def slice_time(self, start: float, stop: float) -> "Channel":
        """Return the samples with `start` ≤ time ≤ `stop`, without those before as history.

        Raises
        ------
        InvalidRecord
            If there is none.
        """
        first, last = np.searchsorted(self.times, [start, np.nextafter(stop, np.inf)])
        if first == last:
            raise InvalidRecord(
                f"channel {self.name!r} has no sample from {start:g} to {stop:g} s; "
                f"its samples are from {self.times[0]:g} to {self.times[-1]:g} s"
            )
        return replace(
            self,
            times=self.times[first:last],
            values=self.values[first:last],
            history=self.history if first == 0 else None,
            repeats=None if self.repeats is None else self.repeats[first:last],
        )

    def slice_with_history(self, start: float, stop: float) -> "Channel":
        """Return the samples of `slice_time`, with all earlier samples as their history."""
        return self.slice_time(start, stop).prepend_history(self)

    def prepend_history(self, other: "Channel") -> "Channel":
        """Return this channel with the earlier samples of another channel as its history."""
        whole = other.history_and_samples
        count = int(np.searchsorted(whole.times, self.times[0]))
        history = History(whole.times[:count], whole.values[:count]) if count else None
        return replace(self, history=history)


Channels: TypeAlias = Channel | Sequence[Channel] | Labelled
"""What is read as channels: one, several, or a table or series of another library."""

_MAX_LISTED = 12  # channels in the text of a record


def to_channels(groups: Sequence[tuple[Channels, str]]) -> list[tuple[Channel, ...]]:
    """Read groups of channels on one time axis; each group has a name for messages.

    Channels with a `started_at` keep their distance: all are in seconds from the first of these.

    Raises
    ------
    InvalidRecord
        If an object is no channel and has none, or times or values cannot be read. If only some
        channels have a `started_at`, or only some of these have a time zone.
    """
    read = [tuple(_iterate_channels(group, owner)) for group, owner in groups]
    return _align_clocks(read, find_first_start(c.started_at for one in read for c in one))


def _align_clocks(
    groups: list[tuple[Channel, ...]], origin: datetime | None
) -> list[tuple[Channel, ...]]:
    """Return groups of channels with times in s from one moment."""
    if origin is None:
        return groups
    channels = [channel for group in groups for channel in group]
    without = next((c for c in channels if c.started_at is None), None)
    if without is not None:
        dated = next(channel for channel in channels if channel.started_at is not None)
        raise InvalidRecord(
            f"channel {dated.name!r} has dates, and channel {without.name!r} has seconds of an "
            "unknown start; give it dates too, or its `started_at`"
        )
    return [tuple(_count_from(channel, origin) for channel in group) for group in groups]


def _iterate_channels(group: Any, owner: str) -> Iterator[Channel]:
    if isinstance(group, Channel):
        yield group
    elif is_labelled(group):
        columns = read_columns(group, owner)
        for column in columns:
            yield to_channel(column, f"signal{columns.index(column) + 1}")
    elif isinstance(group, Sequence) and not isinstance(group, str):
        for item in group:
            if not (isinstance(item, Channel) or is_labelled(item)):
                raise InvalidRecord(
                    f"{owner} has {describe_object(item)} in its list; need channels"
                )
            yield from _iterate_channels(item, owner)
    else:
        raise InvalidRecord(
            f"{owner}: found {describe_object(group)}; need a channel, several, or a table or "
            "series with names and times"
        )


def to_channel(column: Column, otherwise: str = "") -> Channel:
    """Read a column of a table as a channel; `otherwise` is its name if it has none.

    What is refused of a file is so of a table: infinite values, and times that repeat.
    """
    name, (times, start, unit) = column.name or otherwise, column.axis
    channel = Channel(name, times, column.values, column.unit, started_at=start, time_unit=unit)
    repeated = np.flatnonzero(np.diff(channel.times) == 0)
    if repeated.size:
        raise InvalidRecord(
            f"the times of channel {name!r} repeat: samples {repeated[0] + 1} and "
            f"{repeated[0] + 2} are both at {channel.times[repeated[0]]:g} s; times must increase "
            "from row to row"
        )
    if fault := find_infinite_value([channel]):
        raise InvalidRecord(fault)
    return channel


def _count_from(channel: Channel, origin: datetime) -> Channel:
    """Return the same channel with its times in s from another moment."""
    shift = measure_distance(channel.started_at or origin, origin)
    if not shift:
        return channel if channel.started_at == origin else replace(channel, started_at=origin)
    history = channel.history
    if history is not None:
        history = history._replace(times=history.times + shift)
    return replace(channel, times=channel.times + shift, history=history, started_at=origin)


def _describe_samples(channel: Channel) -> str:
    finite = channel.values[np.isfinite(channel.values)]
    missing = channel.values.size - finite.size
    text = f"{channel.sampling}, {_describe_range(channel.times[0], channel.times[-1])} s"
    if finite.size:
        text += f", values {_describe_range(np.min(finite), np.max(finite))}"
    if missing:
        text += f", {missing} missing"
    before = channel.history
    return text if before is None else f"{text}, {before.times.size} samples before"


def _describe_span(record: "Record | Recording") -> str:
    return f"{_describe_range(record.start, record.stop)} s"


def _describe_range(first: float, last: float) -> str:
    return f"from {first:.4g} to {last:.4g}"


def _list_channels(role: str, channels: Sequence[Channel]) -> list[str]:
    lines = [
        f"  {role}{channel.name}{'' if channel.unit == '1' else f' [{channel.unit}]'}: "
        f"{_describe_samples(channel)}"
        for channel in channels[:_MAX_LISTED]
    ]
    left = len(channels) - _MAX_LISTED
    return [*lines, f"  and {left} more"] if left > 0 else lines


@dataclass(frozen=True, slots=True)
class Segment:
    """A part of a recording that was measured on its own, such as one repeat of a test.

    Segments follow one another on the recording's time axis. A segment's own time is the
    recording's time minus `start` plus `origin`.
    """

    start: float
    stop: float
    origin: float = 0.0
    labels: Mapping[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Recording:
    """All channels of one dataset, without roles; without segments it is one measurement.

    The channels may be a table of pandas, xarray or polars, or a mapping of lists. Its times are
    the index, or the column ``t`` or ``time``, in seconds or as dates. Dates become seconds from
    the first one, which is kept.

    Attributes
    ----------
    channels : tuple of Channel
    segments : tuple of Segment
    started_at : datetime or None
        Time 0 s on the clock that recorded; None if it is not known. Without a zone it is local
        time of an unknown zone. All channels have the same.

    Examples
    --------
    >>> Recording({"t": [0.0, 0.5, 1.0], "P1 [bar]": [1.0, 1.2, 1.1], "P2 [bar]": [0.0, 0.1, 0.3]})
    Recording of 2 channels, from 0 to 1 s
      P1 [bar]: 3 samples, every 0.5 s, from 0 to 1 s, values from 1 to 1.2
      P2 [bar]: 3 samples, every 0.5 s, from 0 to 1 s, values from 0 to 0.3
    """

    channels: tuple[Channel, ...]
    segments: tuple[Segment, ...] = ()
    started_at: datetime | None = None

    if TYPE_CHECKING:

        def __init__(
            self,
            channels: Channels,
            segments: tuple[Segment, ...] = (),
            started_at: datetime | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        channels = tuple(_iterate_channels(self.channels, "the recording"))
        origin = self.started_at
        if origin is None:
            origin = find_first_start(channel.started_at for channel in channels)
        else:
            channels = tuple(
                replace(c, started_at=origin) if c.started_at is None else c for c in channels
            )
        object.__setattr__(self, "channels", _align_clocks([channels], origin)[0])
        object.__setattr__(self, "started_at", origin)

    def __repr__(self) -> str:
        parts = f", {len(self.segments)} segments" if self.segments else ""
        count = len(self.channels)
        head = f"Recording of {count} channel{'s' if count != 1 else ''}{parts}"
        if not count:
            return head
        return "\n".join([f"{head}, {_describe_span(self)}", *_list_channels("", self.channels)])

    def __getitem__(self, name: str) -> Channel:
        """Return the channel of a name; see `channel`."""
        return self.channel(name)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the channels, so that ``"P1" in recording`` holds."""
        return iter(self.names)

    def __len__(self) -> int:
        """Return the number of channels."""
        return len(self.channels)

    def channel(self, name: str) -> Channel:
        """Return the channel of a name.

        Raises
        ------
        InvalidRecord
            If there is none; the message suggests the nearest, or lists all.
        """
        return _find_channel(self.channels, name, "the recording")

    def to_pandas(self) -> Any:
        """Return the channels as a table of pandas, from which `Recording` reads them again.

        Columns are called ``P1 [bar]``. The index has dates if `started_at` is known, else seconds.
        Histories and segments are left out. Channels on other times have gaps (``nan``).

        Raises
        ------
        MissingLibrary
            If pandas is not installed.
        InvalidRecord
            If times repeat, and not all channels have the same.
        """
        return _to_frame(self.channels)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels, in their order."""
        return tuple(channel.name for channel in self.channels)

    @property
    def start(self) -> float:
        """First time of any channel, in s."""
        return min(float(channel.times[0]) for channel in self.channels)

    @property
    def stop(self) -> float:
        """Last time of any channel, in s."""
        return max(float(channel.times[-1]) for channel in self.channels)

    @property
    def duration(self) -> float:
        """Seconds from the first to the last sample of any channel."""
        return self.stop - self.start

    @property
    def samples(self) -> int:
        """Samples of the longest channel."""
        return max(channel.times.size for channel in self.channels)

    @property
    def sampling(self) -> Sampling:
        """Sampling of the longest channel."""
        return max(self.channels, key=lambda channel: channel.times.size).sampling

    def replace_holds(self, holds: Mapping[str, HoldSetting]) -> "Recording":
        """Return the recording with other intersample behaviour of some channels.

        Raises
        ------
        InvalidRecord
            If there is no channel of that name.
        """
        for name in holds:
            self.channel(name)
        return replace(self, channels=_replace_holds(self.channels, holds))

    def to_record(
        self, inputs: Mapping[str, str], outputs: Mapping[str, str], name: str = ""
    ) -> "Record":
        """Return the recording as one experiment of a model, with the other channels beside it.

        Parameters
        ----------
        inputs, outputs : mapping of str to str
            Assignment of channels to signals: model's name → channel's name.

        Raises
        ------
        InvalidRecord
            If a channel is missing, or is both an input and an output, or has no value. If the
            recording has several segments.
        """
        for fault in find_shared_channels(inputs, outputs).values():
            raise InvalidRecord(fault)
        if len(self.segments) > 1:
            raise InvalidRecord(
                f"the recording has {len(self.segments)} segments, each measured on its own. "
                "Derive one record with 'pool' or 'select', or use every segment as an experiment."
            )
        return Record(
            tuple(
                _to_input(self.channel(name_in_recording), role)
                for role, name_in_recording in inputs.items()
            ),
            tuple(
                _to_output(self.channel(name_in_recording), role)
                for role, name_in_recording in outputs.items()
            ),
            name,
            tuple(c for c in self.channels if c.name not in {*inputs.values(), *outputs.values()}),
        )

    def split_segments(self) -> tuple["Recording", ...]:
        """Return every segment as a recording on its own times; without segments, this one.

        A segment has no `started_at`: its times may count from its own start.
        """
        if not self.segments:
            return (self,)
        return tuple(self._cut_segment(segment) for segment in self.segments)

    def _cut_segment(self, segment: Segment) -> "Recording":
        cut = [channel.slice_time(segment.start, segment.stop) for channel in self.channels]
        return Recording(tuple(_shift_to_segment(channel, segment) for channel in cut))


def find_shared_channels(inputs: Mapping[str, str], outputs: Mapping[str, str]) -> dict[str, str]:
    """Find inputs whose channel is also an output, with a message for each.

    Parameters
    ----------
    inputs, outputs : mapping of str to str
        Model's name → channel's name.
    """
    output_names = {channel: name for name, channel in outputs.items()}
    return {
        name: f"channel {channel!r} is both input {name!r} and output "
        f"{output_names[channel]!r}; an output that is its own input contains no information"
        for name, channel in inputs.items()
        if channel in output_names
    }


def to_segment_time(times: FloatArray, segment: Segment) -> FloatArray:
    """Convert times of a recording to a segment's own times, to the nanosecond.

    The rounding removes the error that the shift on the recording's axis added.
    """
    return np.round(times - segment.start + segment.origin, 9)


def _find_first_known_time(channel: Channel) -> float:
    history = trim_missing_history(channel.history)
    return float(channel.times[0] if history is None else history.times[0])


def _shift_to_segment(channel: Channel, segment: Segment) -> Channel:
    history = channel.history
    if history is not None:
        history = history._replace(times=to_segment_time(history.times, segment))
    times = to_segment_time(channel.times, segment)
    return replace(channel, times=times, history=history, started_at=None)


def _to_input(channel: Channel, role: str) -> Channel:
    """Make a channel an input: samples without a value are no samples, as missing rows are none."""
    known = select_known(channel)
    return replace(known, name=role, history=trim_missing_history(channel.history))


def select_known(channel: Channel) -> Channel:
    """Return a channel without the samples that have no value; itself if all have one.

    Raises
    ------
    InvalidRecord
        If no sample has a value.
    """
    is_known = np.isfinite(channel.values)
    if is_known.all():
        return channel
    if not is_known.any():
        raise InvalidRecord(f"channel {channel.name!r} has no value: all are missing (NaN)")
    return replace(
        channel,
        times=channel.times[is_known],
        values=channel.values[is_known],
        repeats=None if channel.repeats is None else channel.repeats[is_known],
    )


def trim_missing_history(history: History | None) -> History | None:
    """Cut a history after its last missing value: earlier samples may be of another test."""
    if history is None:
        return None
    missing = np.flatnonzero(~np.isfinite(history.values))
    first = int(missing[-1]) + 1 if missing.size else 0
    if first == history.values.size:
        return None
    return History(history.times[first:], history.values[first:])


def _to_output(channel: Channel, role: str) -> Channel:
    if not np.any(np.isfinite(channel.values)):
        raise InvalidRecord(
            f"output {role!r} (channel {channel.name!r}) has no value: all are missing (NaN)"
        )
    return replace(channel, name=role, history=None)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Record:
    """One experiment of a model: inputs and outputs, each one channel or several.

    A side may be a channel, a sequence of channels, or a table or series of pandas, xarray or
    polars. If the times are dates, all channels are in seconds from the first date of any of them,
    their `started_at`. Channels usually have the names of the model's signals.

    Attributes
    ----------
    inputs, outputs : tuple of Channel
    name : str
    others : tuple of Channel
        What was recorded beside them, on the same clock. No simulation reads it, and a part of a
        record keeps all of it. Explanations of residuals look there for another input.
    findings : tuple of Finding
        What happened to the recording that it was made from.

    Examples
    --------
    >>> t = [0.0, 0.1, 0.2, 0.3]
    >>> Record(Channel("u", t, [0, 1, 1, 1], unit="%"), Channel("y", t, [20.0, 20.0, 20.4, 20.7]))
    Record, from 0 to 0.3 s
      input u [%]: 4 samples, every 0.1 s, from 0 to 0.3 s, values from 0 to 1
      output y: 4 samples, every 0.1 s, from 0 to 0.3 s, values from 20 to 20.7
    """

    inputs: tuple[Channel, ...]
    outputs: tuple[Channel, ...]
    name: str = ""
    others: tuple[Channel, ...] = ()
    findings: tuple[Finding, ...] = ()

    if TYPE_CHECKING:

        def __init__(
            self,
            inputs: Channels,
            outputs: Channels,
            name: str = "",
            others: tuple[Channel, ...] = (),
            findings: tuple[Finding, ...] = (),
        ) -> None: ...

    def __post_init__(self) -> None:
        sides = [(self.inputs, "the input side"), (self.outputs, "the output side")]
        inputs, outputs = to_channels(sides)
        object.__setattr__(self, "inputs", inputs)
        object.__setattr__(self, "outputs", outputs)

    def __repr__(self) -> str:
        title = f"Record {self.name!r}" if self.name else "Record"
        sides = (*_list_channels("input ", self.inputs), *_list_channels("output ", self.outputs))
        span = f", {_describe_span(self)}" if sides else ", without channels"
        return "\n".join([title + span, *sides])

    def __getitem__(self, name: str) -> Channel:
        """Return the input or output of a name.

        Raises
        ------
        InvalidRecord
            If there is none; the message suggests the nearest, or lists all.
        """
        return _find_channel((*self.inputs, *self.outputs), name, "the record")

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of inputs and outputs, so that ``"u" in record`` holds."""
        return (channel.name for channel in (*self.inputs, *self.outputs))

    def __len__(self) -> int:
        """Return the number of inputs and outputs."""
        return len(self.inputs) + len(self.outputs)

    def to_pandas(self) -> Any:
        """Return inputs and outputs as a table of pandas, as `Recording.to_pandas` does."""
        return _to_frame((*self.inputs, *self.outputs))

    def replace_holds(self, holds: Mapping[str, HoldSetting]) -> "Record":
        """Return the record with other intersample behaviour of some inputs and outputs."""
        if not holds:
            return self
        inputs, outputs = (_replace_holds(side, holds) for side in (self.inputs, self.outputs))
        return replace(self, inputs=inputs, outputs=outputs)

    @property
    def history_duration(self) -> float:
        """Time (s) before the start for which all inputs have a history; 0 without one."""
        return max(
            self.start
            - max((_find_first_known_time(channel) for channel in self.inputs), default=np.inf),
            0.0,
        )

    @property
    def start(self) -> float:
        """First time of any channel, in s."""
        return min(float(channel.times[0]) for channel in (*self.inputs, *self.outputs))

    @property
    def stop(self) -> float:
        """Last time of any channel, in s."""
        return max(float(channel.times[-1]) for channel in (*self.inputs, *self.outputs))

    @property
    def duration(self) -> float:
        """Seconds from the first to the last sample of any channel."""
        return self.stop - self.start


def _find_channel(channels: Sequence[Channel], name: str, owner: str) -> Channel:
    for channel in channels:
        if channel.name == name:
            return channel
    names = [channel.name for channel in channels]
    raise InvalidRecord(f"{owner} has no channel {name!r}{suggest_name(str(name), names)}")


def _to_frame(channels: Sequence[Channel]) -> Any:
    return to_frame(
        [
            Column(
                append_unit(channel.name, channel.unit),
                channel.name,
                channel.unit,
                TimeAxis(channel.times, channel.started_at, channel.time_unit),
                channel.values,
            )
            for channel in channels
        ]
    )


def _replace_holds(
    channels: Sequence[Channel], holds: Mapping[str, HoldSetting]
) -> tuple[Channel, ...]:
    return tuple(
        replace(channel, hold=holds.get(channel.name, channel.hold)) for channel in channels
    )


def find_common_sample_time(records: Sequence[Record]) -> float | None:
    """Find the sampling period (s) that all outputs of all records share; None without one."""
    samplings = [channel.sampling for record in records for channel in record.outputs]
    periods = [sampling.period for sampling in samplings]
    if not all(sampling.is_regular for sampling in samplings) or np.ptp(
        periods
    ) > _PERIOD_TOLERANCE * min(periods):
        return None
    return periods[0]


def keep_outputs(records: Sequence[Record], select: Callable[[Channel], BoolArray]) -> list[Record]:
    """Keep the samples of outputs that are selected; the others are missing then."""
    return [
        replace(
            record,
            outputs=tuple(
                replace(one, values=np.where(select(one), one.values, np.nan))
                for one in record.outputs
            ),
        )
        for record in records
    ]
