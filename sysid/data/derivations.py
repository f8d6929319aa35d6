"""Derivation of recordings from recordings, by steps with plain values.

A step is a mapping with one key, such as ``{"trim": {"start": 2, "stop": 8}}``. The steps of a
list are applied in order.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from sysid.core.errors import InvalidRecord, InvalidSettings, join_pointer, suggest_name
from sysid.core.units import (
    describe_difference,
    find_conversion_factor,
    is_blank_unit,
    is_readable_unit,
    suggest_unit,
)
from sysid.data.derivation_arguments import StepArguments
from sysid.data.history import attach_history, change_values, drop_history
from sysid.data.noise import NOISE_KINDS, Noise, draw_noise
from sysid.data.pooling import pool_segments, select_segments
from sysid.data.records import HOLDS, Channel, Recording, Segment
from sysid.data.resampling import resample_recording
from sysid.data.splitting import find_cut_time

StepFunction = Callable[[Recording, StepArguments], Recording]


class SubtractedTrend(NamedTuple):
    """What ``detrend`` subtracted from a channel: ``value + slope·(t - time)``.

    `time` (s) is that of the first sample. `value` is in the unit that the channel then has,
    `slope` in that unit per second. It is 0 for a mean.
    """

    channel: str
    unit: str
    time: float
    value: float
    slope: float


class Derivation(NamedTuple):
    """A derived recording, and what its steps ``detrend`` subtracted, in their order."""

    recording: Recording
    subtracted: tuple[SubtractedTrend, ...]


def derive_recording(recording: Recording, steps: Sequence[Mapping[str, Any]]) -> Recording:
    """Apply derivation steps to a recording, in order.

    Raises
    ------
    InvalidSettings
        With the JSON pointer of the invalid part, such as ``/steps/2/pool/bin``.
    """
    return apply_steps(recording, steps).recording


def apply_steps(recording: Recording, steps: Sequence[Mapping[str, Any]]) -> Derivation:
    """Apply derivation steps to a recording, in order, and say what was subtracted.

    Raises
    ------
    InvalidSettings
        With the JSON pointer of the invalid part, such as ``/steps/2/pool/bin``.
    """
    if not isinstance(steps, list | tuple) or not steps:
        raise InvalidSettings("/steps", f"found {steps!r}; need a list with one step or more")
    subtracted: list[SubtractedTrend] = []
    for number, step in enumerate(steps):
        if not isinstance(step, Mapping) or len(step) != 1:
            raise InvalidSettings(
                f"/steps/{number}", f"found {step!r}; need an object with one key, the step's name"
            )
        ((name, value),) = step.items()
        pointer = f"/steps/{number}/{name}"
        if name not in STEPS:
            raise InvalidSettings(pointer, f"there is no such step{suggest_name(str(name), STEPS)}")
        arguments = StepArguments(pointer, value)
        try:
            if name == "detrend":
                subtracted += _describe_trends(recording, _fit_trends(recording, arguments))
            recording = STEPS[name](recording, arguments)
        except InvalidRecord as error:
            raise InvalidSettings(pointer, str(error)) from None
    return Derivation(recording, tuple(subtracted))


def add_noise(recording: Recording, arguments: StepArguments) -> Recording:
    """Add noise of standard deviation `sigma` (in the channel's unit) to the named channels.

    The draw depends on the seed and on the channel's position in the list. The noise of a job
    depends on the output's position in the same way, so the numbers are equal.
    """
    arguments.reject_others("sigma", "seed", "channels", "kind", "terms", "mean")
    names = arguments.read_texts("channels")
    try:
        noise = Noise(
            arguments.read_number("sigma"),
            arguments.read_whole_number("seed", 0),
            arguments.read_choice("kind", NOISE_KINDS, "gaussian"),
            arguments.read_whole_number("terms", 12, most=1000),
            arguments.read_number("mean", 0.0),
        )
    except InvalidSettings as error:
        arguments.fail(error.pointer.rpartition("/")[2], error.detail)
    return _change_channels(
        recording,
        names,
        lambda channel: _add_channel_noise(channel, noise, names.index(channel.name)),
    )


def _add_channel_noise(channel: Channel, noise: Noise, stream: int) -> Channel:
    """Add noise; the samples are drawn first, so that a history does not change their draw."""
    size, history = channel.values.size, channel.history
    if history is None:
        return replace(channel, values=channel.values + draw_noise(noise, size, stream))
    drawn = draw_noise(noise, size + history.values.size, stream)
    return replace(
        channel,
        values=channel.values + drawn[:size],
        history=history._replace(values=history.values + drawn[size:]),
    )


def trim_recording(recording: Recording, arguments: StepArguments) -> Recording:
    """Keep a span of time (`start` to `stop`, s) or of samples (`rows`: [first, last + 1]).

    Samples before the span become its history, unless `history` is false.
    """
    arguments.reject_others("start", "stop", "rows", "history")
    if arguments.has_argument("rows"):
        if arguments.has_argument("start") or arguments.has_argument("stop"):
            arguments.fail(
                "rows", "cannot be combined with start or stop; give rows, or start and stop"
            )
        return _attach_or_drop_history(_cut_rows(recording, arguments), recording, arguments)
    if not arguments.has_argument("start") and not arguments.has_argument("stop"):
        arguments.fail("", "need start, stop (seconds), or rows")
    start = arguments.read_number("start", recording.start)
    stop = arguments.read_number("stop", recording.stop)
    if stop <= start:
        arguments.fail("stop", f"found {stop!r}; need more than the start, {start!r}")
    return _attach_or_drop_history(_cut_span(recording, start, stop), recording, arguments)


def _attach_or_drop_history(
    part: Recording, whole: Recording, arguments: StepArguments
) -> Recording:
    if arguments.read_flag("history", default=True):
        return attach_history(part, whole)
    return drop_history(part)


def _cut_rows(recording: Recording, arguments: StepArguments) -> Recording:
    first, last = arguments.read_range("rows")
    times = recording.channels[0].times
    if any(not np.array_equal(channel.times, times) for channel in recording.channels):
        arguments.fail("rows", "the channels have different times; give start and stop in seconds")
    if last > times.size:
        arguments.fail("rows", f"found [{first}, {last}]; the recording has {times.size} rows")
    channels = tuple(
        replace(
            channel,
            times=channel.times[first:last],
            values=channel.values[first:last],
            history=None,
        )
        for channel in recording.channels
    )
    segments = _clip_segments(recording.segments, times[first], times[last - 1])
    return replace(recording, channels=channels, segments=segments)


def _cut_span(recording: Recording, start: float, stop: float) -> Recording:
    channels = tuple(channel.slice_time(start, stop) for channel in recording.channels)
    segments = _clip_segments(recording.segments, start, stop)
    return replace(recording, channels=channels, segments=segments)


def _clip_segments(segments: tuple[Segment, ...], start: float, stop: float) -> tuple[Segment, ...]:
    return tuple(
        replace(
            segment,
            start=float(max(segment.start, start)),
            stop=float(min(segment.stop, stop)),
            origin=float(segment.origin + max(start - segment.start, 0.0)),
        )
        for segment in segments
        if segment.start <= stop and segment.stop >= start
    )


def split_recording(recording: Recording, arguments: StepArguments) -> Recording:
    """Keep the last `fraction` of the samples (``validation``) or those before (``estimation``).

    Samples before the part become its history, unless `history` is false.
    """
    arguments.reject_others("fraction", "part", "history")
    part = arguments.read_choice("part", ("estimation", "validation"))
    longest = max((channel.times for channel in recording.channels), key=len)
    cut = find_cut_time(longest, arguments.read_number("fraction"), f"{arguments.pointer}/fraction")
    if part == "validation":
        return _attach_or_drop_history(_cut_span(recording, cut, np.inf), recording, arguments)
    before = _cut_span(recording, -np.inf, float(np.nextafter(cut, -np.inf)))
    return _attach_or_drop_history(before, recording, arguments)


def detrend_channels(recording: Recording, arguments: StepArguments) -> Recording:
    """Subtract the mean or the least-squares line; missing values are ignored."""
    trends = _fit_trends(recording, arguments)
    return _change_channels(
        recording,
        list(trends),
        lambda channel: change_values(
            channel, lambda times, values: np.asarray(values - trends[channel.name](times))
        ),
    )


def _fit_trends(recording: Recording, arguments: StepArguments) -> dict[str, Polynomial]:
    """Fit the mean or the line of each channel that a step names."""
    arguments.reject_others("kind", "channels")
    degree = ("mean", "linear").index(arguments.read_choice("kind", ("mean", "linear"), "mean"))
    names = (
        arguments.read_texts("channels")
        if arguments.has_argument("channels")
        else list(recording.names)
    )

    trends = {}
    for channel in map(recording.channel, names):
        is_present = np.isfinite(channel.values)
        if np.count_nonzero(is_present) <= degree:
            arguments.fail("", f"channel {channel.name!r} has too few values")
        trends[channel.name] = Polynomial.fit(
            channel.times[is_present], channel.values[is_present], degree
        )
    return trends


def _describe_trends(
    recording: Recording, trends: Mapping[str, Polynomial]
) -> Iterator[SubtractedTrend]:
    for name, trend in trends.items():
        channel = recording.channel(name)
        start = float(channel.times[0])
        slope = float(trend.deriv()(start))
        yield SubtractedTrend(name, channel.unit, start, float(trend(start)), slope)


def subtract_offset(recording: Recording, arguments: StepArguments) -> Recording:
    """Subtract a number from each named channel."""
    offsets = {name: arguments.read_number(name) for name, _ in arguments.get_items()}
    return _change_channels(
        recording,
        list(offsets),
        lambda channel: change_values(channel, lambda _, values: values - offsets[channel.name]),
    )


def clip_channels(recording: Recording, arguments: StepArguments) -> Recording:
    """Limit the values of named channels to `min` and `max`, in the channel's unit."""
    limits = {
        name: _read_limits(StepArguments(arguments.pointer + join_pointer(name), value))
        for name, value in arguments.get_items()
    }
    return _change_channels(
        recording,
        list(limits),
        lambda channel: change_values(
            channel, lambda _, values: np.clip(values, *limits[channel.name])
        ),
    )


def _read_limits(arguments: StepArguments) -> tuple[float, float]:
    arguments.reject_others("min", "max")
    if not arguments.has_argument("min") and not arguments.has_argument("max"):
        arguments.fail("", "need min, max, or both")
    low, high = (
        arguments.read_number(name) if arguments.has_argument(name) else limit
        for name, limit in (("min", -np.inf), ("max", np.inf))
    )
    if high < low:
        arguments.fail("max", f"found {high!r}; need min or more, {low!r}")
    return low, high


def set_hold(recording: Recording, arguments: StepArguments) -> Recording:
    """Set the intersample behaviour of named channels, for use as inputs."""
    return recording.replace_holds(
        {name: arguments.read_choice(name, HOLDS) for name, _ in arguments.get_items()}
    )


def set_unit(recording: Recording, arguments: StepArguments) -> Recording:
    """Convert named channels to other units; a channel without a unit is only labelled."""
    units = {name: arguments.read_text(name) for name, _ in arguments.get_items()}
    converted = {}
    for name, unit in units.items():
        channel = recording.channel(name)
        factor = (
            1.0
            if is_blank_unit(channel.unit) or is_blank_unit(unit)
            else find_conversion_factor(channel.unit, unit)
        )
        if factor is None:
            unread = [f"{text!r}" for text in (channel.unit, unit) if not is_readable_unit(text)]
            difference = (
                describe_difference(channel.unit, unit) or f"{' and '.join(unread)} cannot be read"
            )
            need = f"need a unit of the same quantity as {channel.unit}"
            arguments.fail(name, f"{difference}; {need}{suggest_unit(unit)}")
        converted[name] = replace(_scale_channel(channel, factor), unit=unit.strip() or "1")
    channels = tuple(converted.get(channel.name, channel) for channel in recording.channels)
    return replace(recording, channels=channels)


def _scale_channel(channel: Channel, factor: float) -> Channel:
    return channel if factor == 1.0 else change_values(channel, lambda _, values: values * factor)


def rename_channels(recording: Recording, arguments: StepArguments) -> Recording:
    """Rename channels."""
    names = {old: arguments.read_text(old) for old, _ in arguments.get_items()}
    for old in names:
        recording.channel(old)
    renamed = [names.get(name, name) for name in recording.names]
    for name in renamed:
        if not name or renamed.count(name) > 1:
            arguments.fail("", f"two channels would be called {name!r}, or a channel has no name")
    return replace(
        recording,
        channels=tuple(
            replace(channel, name=name)
            for channel, name in zip(recording.channels, renamed, strict=True)
        ),
    )


def _change_channels(
    recording: Recording, names: Sequence[str], change: Callable[[Channel], Channel]
) -> Recording:
    for name in names:
        recording.channel(name)
    return replace(
        recording,
        channels=tuple(
            change(channel) if channel.name in names else channel for channel in recording.channels
        ),
    )


STEPS: Mapping[str, StepFunction] = {
    "noise": add_noise,
    "resample": resample_recording,
    "trim": trim_recording,
    "detrend": detrend_channels,
    "offset": subtract_offset,
    "clip": clip_channels,
    "split": split_recording,
    "select": select_segments,
    "pool": pool_segments,
    "hold": set_hold,
    "rename": rename_channels,
    "unit": set_unit,
}
