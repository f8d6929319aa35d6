"""Recordings made from recordings: pure functions, named and parametrised by plain values.

A step is a mapping with one key, such as ``{"trim": {"start": 2, "stop": 8}}``. The steps of a
list are taken one after the other.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.core.errors import InvalidRecord, InvalidSettings, nearest
from sysid.core.units import difference, factor, is_blank, is_read, suggestion
from sysid.data.arguments import Arguments
from sysid.data.history import changed, with_history, without_history
from sysid.data.noise import NOISE_KINDS, Noise, noise_samples
from sysid.data.pooling import pool, select
from sysid.data.records import HOLDS, Channel, Recording, Segment
from sysid.data.resampling import resample
from sysid.data.splitting import time_of_cut

Step = Callable[[Recording, Arguments], Recording]


def derive(recording: Recording, steps: Sequence[Mapping[str, Any]]) -> Recording:
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
            raise InvalidSettings(pointer, f"there is no such step{nearest(str(name), STEPS)}")
        try:
            recording = STEPS[name](recording, Arguments(pointer, value))
        except InvalidRecord as error:
            raise InvalidSettings(pointer, str(error)) from None
    return recording


def add_noise(recording: Recording, given: Arguments) -> Recording:
    """Add noise of standard deviation `sigma` (in the channel's unit) to the named channels.

    The draw depends on the seed and on the channel's place in the list, as the noise of a job
    depends on the output's place: the same numbers either way.
    """
    given.only("sigma", "seed", "channels", "kind", "terms", "mean")
    names = given.texts("channels")
    try:
        noise = Noise(
            given.number("sigma"),
            given.whole("seed", 0),
            given.choice("kind", NOISE_KINDS, "gaussian"),
            given.whole("terms", 12, most=1000),
            given.number("mean", 0.0),
        )
    except InvalidSettings as error:
        given.fail(error.pointer.rpartition("/")[2], error.detail)
    return _with_channels(recording, names, lambda one: _noisy(one, noise, names.index(one.name)))


def _noisy(channel: Channel, noise: Noise, stream: int) -> Channel:
    """Noise on the samples first, so that their draw is the same with a history and without."""
    size, history = channel.values.size, channel.history
    if history is None:
        return replace(channel, values=channel.values + noise_samples(noise, size, stream))
    drawn = noise_samples(noise, size + history.values.size, stream)
    return replace(
        channel, values=channel.values + drawn[:size],
        history=history._replace(values=history.values + drawn[size:]),
    )  # fmt: skip


def trim(recording: Recording, given: Arguments) -> Recording:
    """Keep a span of time (`start` to `stop`, s) or of samples (`rows`: [first, last + 1]).

    What was recorded before the span goes with it as history, unless `history` is false.
    """
    given.only("start", "stop", "rows", "history")
    if given.has("rows"):
        if given.has("start") or given.has("stop"):
            given.fail("rows", "is given together with a time; give rows, or start and stop")
        return _cut_out(_rows(recording, given), recording, given)
    if not given.has("start") and not given.has("stop"):
        given.fail("", "need start, stop (seconds), or rows")
    start = given.number("start", recording.start)
    stop = given.number("stop", recording.stop)
    if stop <= start:
        given.fail("stop", f"found {stop!r}; need more than the start, {start!r}")
    return _cut_out(_span(recording, start, stop), recording, given)


def _cut_out(part: Recording, whole: Recording, given: Arguments) -> Recording:
    if given.flag("history", default=True):
        return with_history(part, whole)
    return without_history(part)


def _rows(recording: Recording, given: Arguments) -> Recording:
    first, last = given.pair("rows")
    times = recording.channels[0].times
    if any(not np.array_equal(one.times, times) for one in recording.channels):
        given.fail("rows", "the channels have different times; give start and stop in seconds")
    if last > times.size:
        given.fail("rows", f"found [{first}, {last}]; the recording has {times.size} rows")
    channels = tuple(
        replace(one, times=one.times[first:last], values=one.values[first:last], history=None)
        for one in recording.channels
    )
    return Recording(channels, _clipped(recording.segments, times[first], times[last - 1]))


def _span(recording: Recording, start: float, stop: float) -> Recording:
    channels = tuple(one.between(start, stop) for one in recording.channels)
    return Recording(channels, _clipped(recording.segments, start, stop))


def _clipped(segments: tuple[Segment, ...], start: float, stop: float) -> tuple[Segment, ...]:
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


def split(recording: Recording, given: Arguments) -> Recording:
    """Keep one part: the last `fraction` of the samples (``validation``) or what comes before.

    What was recorded before the part goes with it as history, unless `history` is false.
    """
    given.only("fraction", "part", "history")
    part = given.choice("part", ("estimation", "validation"))
    longest = max((one.times for one in recording.channels), key=len)
    cut = time_of_cut(longest, given.number("fraction"), f"{given.pointer}/fraction")
    if part == "validation":
        return _cut_out(_span(recording, cut, np.inf), recording, given)
    before = _span(recording, -np.inf, float(np.nextafter(cut, -np.inf)))
    return _cut_out(before, recording, given)


def detrend(recording: Recording, given: Arguments) -> Recording:
    """Subtract the mean or the straight line of least squares; missing values do not count."""
    given.only("kind", "channels")
    degree = ("mean", "linear").index(given.choice("kind", ("mean", "linear"), "mean"))
    names = given.texts("channels") if given.has("channels") else list(recording.names)

    def flat(channel: Channel) -> Channel:
        known = np.isfinite(channel.values)
        if np.count_nonzero(known) <= degree:
            given.fail("", f"channel {channel.name!r} has too few values")
        trend = np.polynomial.Polynomial.fit(channel.times[known], channel.values[known], degree)
        return changed(channel, lambda times, values: np.asarray(values - trend(times)))

    return _with_channels(recording, names, flat)


def subtract_offset(recording: Recording, given: Arguments) -> Recording:
    """Subtract a number from each named channel."""
    offsets = {name: given.number(name) for name, _ in given.items()}
    return _with_channels(
        recording,
        list(offsets),
        lambda one: changed(one, lambda _, values: values - offsets[one.name]),
    )


def set_hold(recording: Recording, given: Arguments) -> Recording:
    """Say what named channels do between their samples, when they are inputs."""
    return recording.held({name: given.choice(name, HOLDS) for name, _ in given.items()})


def set_unit(recording: Recording, given: Arguments) -> Recording:
    """Convert named channels to other units; of one that has none the unit is only written down."""
    units = {name: given.text(name) for name, _ in given.items()}
    made = {}
    for name, unit in units.items():
        channel = recording.channel(name)
        times = 1.0 if is_blank(channel.unit) or is_blank(unit) else factor(channel.unit, unit)
        if times is None:
            unread = [f"{one!r}" for one in (channel.unit, unit) if not is_read(one)]
            told = difference(channel.unit, unit) or f"{' and '.join(unread)} cannot be read"
            need = f"need a unit of the same quantity as {channel.unit}"
            given.fail(name, f"{told}; {need}{suggestion(unit)}")
        made[name] = replace(_scaled(channel, times), unit=unit.strip() or "1")
    channels = tuple(made.get(one.name, one) for one in recording.channels)
    return replace(recording, channels=channels)


def _scaled(channel: Channel, by: float) -> Channel:
    return channel if by == 1.0 else changed(channel, lambda _, values: values * by)


def rename(recording: Recording, given: Arguments) -> Recording:
    """Give channels other names."""
    names = {old: given.text(old) for old, _ in given.items()}
    for old in names:
        recording.channel(old)
    renamed = [names.get(name, name) for name in recording.names]
    for name in renamed:
        if not name or renamed.count(name) > 1:
            given.fail("", f"two channels would be called {name!r}, or one has no name")
    return replace(
        recording,
        channels=tuple(
            replace(one, name=name) for one, name in zip(recording.channels, renamed, strict=True)
        ),
    )


def _with_channels(
    recording: Recording, names: Sequence[str], change: Callable[[Channel], Channel]
) -> Recording:
    for name in names:
        recording.channel(name)
    return replace(
        recording,
        channels=tuple(change(one) if one.name in names else one for one in recording.channels),
    )


STEPS: Mapping[str, Step] = {
    "noise": add_noise,
    "resample": resample,
    "trim": trim,
    "detrend": detrend,
    "offset": subtract_offset,
    "split": split,
    "select": select,
    "pool": pool,
    "hold": set_hold,
    "rename": rename,
    "unit": set_unit,
}
