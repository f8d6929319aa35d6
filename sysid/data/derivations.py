"""Recordings made from recordings: pure functions, named and parametrised by plain values.

A step is a mapping with one key, such as ``{"trim": {"start": 2, "stop": 8}}``. The steps of a
list are taken one after the other.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.core.errors import InvalidRecord, InvalidSettings, suggest_name
from sysid.core.units import (
    describe_difference,
    find_conversion_factor,
    is_blank_unit,
    is_readable_unit,
    suggest_unit,
)
from sysid.data.arguments import StepArguments
from sysid.data.history import attach_history, change_values, drop_history
from sysid.data.noise import NOISE_KINDS, Noise, draw_noise
from sysid.data.pooling import pool_segments, select_segments
from sysid.data.records import HOLDS, Channel, Recording, Segment
from sysid.data.resampling import resample_recording
from sysid.data.splitting import find_cut_time

StepFunction = Callable[[Recording, StepArguments], Recording]


def derive_recording(recording: Recording, steps: Sequence[Mapping[str, Any]]) -> Recording:
    """Take all steps.

    Raises
    ------
    InvalidSettings
        With the JSON pointer of what cannot be used, such as ``/steps/2/pool/bin``.
    """
    if not isinstance(steps, list | tuple) or not steps:
        raise InvalidSettings("/steps", f"found {steps!r}; need a list with one step or more")
    for place, step in enumerate(steps):
        if not isinstance(step, Mapping) or len(step) != 1:
            raise InvalidSettings(
                f"/steps/{place}", f"found {step!r}; need an object with one key, the step's name"
            )
        ((name, value),) = step.items()
        pointer = f"/steps/{place}/{name}"
        if name not in STEPS:
            raise InvalidSettings(pointer, f"there is no such step{suggest_name(str(name), STEPS)}")
        try:
            recording = STEPS[name](recording, StepArguments(pointer, value))
        except InvalidRecord as error:
            raise InvalidSettings(pointer, str(error)) from None
    return recording


def add_noise(recording: Recording, given: StepArguments) -> Recording:
    """Add noise of standard deviation `sigma` (in the channel's unit) to the named channels.

    The draw depends on the seed and on the channel's place in the list, as the noise of a job
    depends on the output's place: the same numbers either way.
    """
    given.reject_others("sigma", "seed", "channels", "kind", "terms", "mean")
    names = given.read_texts("channels")
    try:
        noise = Noise(
            given.read_number("sigma"),
            given.read_whole_number("seed", 0),
            given.read_choice("kind", NOISE_KINDS, "gaussian"),
            given.read_whole_number("terms", 12, most=1000),
            given.read_number("mean", 0.0),
        )
    except InvalidSettings as error:
        given.fail(error.pointer.rpartition("/")[2], error.detail)
    return _change_channels(
        recording, names, lambda one: _add_channel_noise(one, noise, names.index(one.name))
    )


def _add_channel_noise(channel: Channel, noise: Noise, stream: int) -> Channel:
    """Noise on the samples first, so that their draw is the same with a history and without."""
    size, history = channel.values.size, channel.history
    if history is None:
        return replace(channel, values=channel.values + draw_noise(noise, size, stream))
    drawn = draw_noise(noise, size + history.values.size, stream)
    return replace(
        channel,
        values=channel.values + drawn[:size],
        history=history._replace(values=history.values + drawn[size:]),
    )


def trim_recording(recording: Recording, given: StepArguments) -> Recording:
    """Keep a span of time (`start` to `stop`, s) or of samples (`rows`: [first, last + 1]).

    What was recorded before the span goes with it as history, unless `history` is false.
    """
    given.reject_others("start", "stop", "rows", "history")
    if given.has_argument("rows"):
        if given.has_argument("start") or given.has_argument("stop"):
            given.fail(
                "rows", "cannot be combined with start or stop; give rows, or start and stop"
            )
        return _attach_or_drop_history(_cut_rows(recording, given), recording, given)
    if not given.has_argument("start") and not given.has_argument("stop"):
        given.fail("", "need start, stop (seconds), or rows")
    start = given.read_number("start", recording.start)
    stop = given.read_number("stop", recording.stop)
    if stop <= start:
        given.fail("stop", f"found {stop!r}; need more than the start, {start!r}")
    return _attach_or_drop_history(_cut_span(recording, start, stop), recording, given)


def _attach_or_drop_history(part: Recording, whole: Recording, given: StepArguments) -> Recording:
    if given.read_flag("history", default=True):
        return attach_history(part, whole)
    return drop_history(part)


def _cut_rows(recording: Recording, given: StepArguments) -> Recording:
    first, last = given.read_range("rows")
    times = recording.channels[0].times
    if any(not np.array_equal(one.times, times) for one in recording.channels):
        given.fail("rows", "the channels have different times; give start and stop in seconds")
    if last > times.size:
        given.fail("rows", f"found [{first}, {last}]; the recording has {times.size} rows")
    channels = tuple(
        replace(one, times=one.times[first:last], values=one.values[first:last], history=None)
        for one in recording.channels
    )
    return Recording(channels, _clip_segments(recording.segments, times[first], times[last - 1]))


def _cut_span(recording: Recording, start: float, stop: float) -> Recording:
    channels = tuple(one.slice_time(start, stop) for one in recording.channels)
    return Recording(channels, _clip_segments(recording.segments, start, stop))


def _clip_segments(segments: tuple[Segment, ...], start: float, stop: float) -> tuple[Segment, ...]:
    return tuple(
        replace(
            one,
            start=float(max(one.start, start)),
            stop=float(min(one.stop, stop)),
            origin=float(one.origin + max(start - one.start, 0.0)),
        )
        for one in segments
        if one.start <= stop and one.stop >= start
    )


def split_recording(recording: Recording, given: StepArguments) -> Recording:
    """Keep one part: the last `fraction` of the samples (``validation``) or what comes before.

    What was recorded before the part goes with it as history, unless `history` is false.
    """
    given.reject_others("fraction", "part", "history")
    part = given.read_choice("part", ("estimation", "validation"))
    longest = max((one.times for one in recording.channels), key=len)
    cut = find_cut_time(longest, given.read_number("fraction"), f"{given.pointer}/fraction")
    if part == "validation":
        return _attach_or_drop_history(_cut_span(recording, cut, np.inf), recording, given)
    before = _cut_span(recording, -np.inf, float(np.nextafter(cut, -np.inf)))
    return _attach_or_drop_history(before, recording, given)


def detrend_channels(recording: Recording, given: StepArguments) -> Recording:
    """Subtract the mean or the straight line of least squares; missing values do not count."""
    given.reject_others("kind", "channels")
    degree = ("mean", "linear").index(given.read_choice("kind", ("mean", "linear"), "mean"))
    names = (
        given.read_texts("channels") if given.has_argument("channels") else list(recording.names)
    )

    def flat(channel: Channel) -> Channel:
        known = np.isfinite(channel.values)
        if np.count_nonzero(known) <= degree:
            given.fail("", f"channel {channel.name!r} has too few values")
        trend = np.polynomial.Polynomial.fit(channel.times[known], channel.values[known], degree)
        return change_values(channel, lambda times, values: np.asarray(values - trend(times)))

    return _change_channels(recording, names, flat)


def subtract_offset(recording: Recording, given: StepArguments) -> Recording:
    """Subtract a number from each named channel."""
    offsets = {name: given.read_number(name) for name, _ in given.get_items()}
    return _change_channels(
        recording,
        list(offsets),
        lambda one: change_values(one, lambda _, values: values - offsets[one.name]),
    )


def set_hold(recording: Recording, given: StepArguments) -> Recording:
    """Say what named channels do between their samples, when they are inputs."""
    return recording.replace_holds(
        {name: given.read_choice(name, HOLDS) for name, _ in given.get_items()}
    )


def set_unit(recording: Recording, given: StepArguments) -> Recording:
    """Convert named channels to other units; of one that has none the unit is only written down."""
    units = {name: given.read_text(name) for name, _ in given.get_items()}
    made = {}
    for name, unit in units.items():
        channel = recording.channel(name)
        times = (
            1.0
            if is_blank_unit(channel.unit) or is_blank_unit(unit)
            else find_conversion_factor(channel.unit, unit)
        )
        if times is None:
            unread = [f"{one!r}" for one in (channel.unit, unit) if not is_readable_unit(one)]
            told = (
                describe_difference(channel.unit, unit) or f"{' and '.join(unread)} cannot be read"
            )
            need = f"need a unit of the same quantity as {channel.unit}"
            given.fail(name, f"{told}; {need}{suggest_unit(unit)}")
        made[name] = replace(_scale_channel(channel, times), unit=unit.strip() or "1")
    channels = tuple(made.get(one.name, one) for one in recording.channels)
    return replace(recording, channels=channels)


def _scale_channel(channel: Channel, by: float) -> Channel:
    return channel if by == 1.0 else change_values(channel, lambda _, values: values * by)


def rename_channels(recording: Recording, given: StepArguments) -> Recording:
    """Give channels other names."""
    names = {old: given.read_text(old) for old, _ in given.get_items()}
    for old in names:
        recording.channel(old)
    renamed = [names.get(name, name) for name in recording.names]
    for name in renamed:
        if not name or renamed.count(name) > 1:
            given.fail("", f"two channels would be called {name!r}, or a channel has no name")
    return replace(
        recording,
        channels=tuple(
            replace(one, name=name) for one, name in zip(recording.channels, renamed, strict=True)
        ),
    )


def _change_channels(
    recording: Recording, names: Sequence[str], change: Callable[[Channel], Channel]
) -> Recording:
    for name in names:
        recording.channel(name)
    return replace(
        recording,
        channels=tuple(change(one) if one.name in names else one for one in recording.channels),
    )


STEPS: Mapping[str, StepFunction] = {
    "noise": add_noise,
    "resample": resample_recording,
    "trim": trim_recording,
    "detrend": detrend_channels,
    "offset": subtract_offset,
    "split": split_recording,
    "select": select_segments,
    "pool": pool_segments,
    "hold": set_hold,
    "rename": rename_channels,
    "unit": set_unit,
}
