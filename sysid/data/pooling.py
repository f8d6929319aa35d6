"""Repeats of a measurement: choosing some of them, and pooling them into one record."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.core.errors import nearest
from sysid.core.types import FloatArray, IntArray
from sysid.data.arguments import Arguments
from sysid.data.records import Channel, Recording, Segment

Label = float | str
Condition = Callable[[Label], bool]


def select(recording: Recording, given: Arguments) -> Recording:
    """Segments whose labels satisfy every condition; they keep their place on the time axis.

    A condition is a value, a list of values, ``{"modulus": m, "remainder": r}``, or
    ``{"min": a, "max": b}``.
    """
    if not recording.segments:
        given.fail("", "the recording has no segments; name its label columns on upload")
    conditions = {name: _condition(name, value, given) for name, value in given.items()}
    for name in conditions:
        known = {label for segment in recording.segments for label in segment.labels}
        if name not in known:
            given.fail(name, f"no segment has such a label{nearest(name, known)}")
    kept = tuple(
        segment
        for segment in recording.segments
        if all(
            name in segment.labels and holds(segment.labels[name])
            for name, holds in conditions.items()
        )
    )
    if not kept:
        given.fail("", f"none of the {len(recording.segments)} segments satisfies this")
    is_first = kept[0] is recording.segments[0]
    return Recording(tuple(_within(one, kept, is_first) for one in recording.channels), kept)


def _within(channel: Channel, kept: tuple[Segment, ...], is_first: bool) -> Channel:
    """Samples of the segments; the history is that of the first one of the recording."""
    starts = np.searchsorted(channel.times, [one.start for one in kept])
    stops = np.searchsorted(channel.times, [one.stop for one in kept], side="right")
    rows = np.concatenate([np.arange(a, b) for a, b in zip(starts, stops, strict=True)])
    history = channel.history if is_first else None
    return replace(channel, times=channel.times[rows], values=channel.values[rows], history=history)


def _condition(name: str, value: Any, given: Arguments) -> Condition:
    if isinstance(value, Mapping):
        inner = Arguments(f"{given.pointer}/{name}", value)
        if inner.has("modulus"):
            return _remainder(inner)
        return _range(inner)
    wanted = value if isinstance(value, list | tuple) else [value]
    for one in wanted:
        if isinstance(one, bool) or not isinstance(one, int | float | str):
            given.fail(name, f"found {one!r}; need a number or a text")
    return lambda label: label in wanted


def _remainder(inner: Arguments) -> Condition:
    inner.only("modulus", "remainder")
    modulus, remainder = inner.positive("modulus"), inner.number("remainder")
    return lambda label: isinstance(label, int | float) and label % modulus == remainder


def _range(inner: Arguments) -> Condition:
    inner.only("min", "max")
    least, most = inner.number("min", -1e308), inner.number("max", 1e308)
    return lambda label: isinstance(label, int | float) and least <= label <= most


def pool(recording: Recording, given: Arguments) -> Recording:
    """One record of all segments, on their own times.

    The input becomes the median of its samples over bins of time, at the mean time of each bin's
    samples; each output keeps every sample at its own time. This resolves a lag that is shorter
    than the sampling period when every repeat has another phase. What the input was before
    ``start`` is its history.

    With ``outputs_from``, conditions as in `select`, outputs are those of some segments only: where
    every repeat has the same input, those kept for validation may help to tell it.
    """
    given.only("input", "outputs", "outputs_from", "bin", "start", "stop")
    start, width = given.number("start", 0.0), given.positive("bin")
    source = recording.channel(given.text("input"))
    kept = _outputs_from(recording, given)
    outputs = [kept.channel(name) for name in given.texts("outputs")]
    last = max(
        float(own_times_of(one, whole.segments).max())
        for one, whole in [(source, recording), *((output, kept) for output in outputs)]
    )
    stop = given.number("stop", float(np.nextafter(last, np.inf)))
    if stop <= start:
        given.fail("stop", f"found {stop!r}; need more than the start, {start!r}")
    pooled = [_input(source, recording.segments, start, stop, width)]
    pooled += [_gathered(one, kept.segments, start, stop) for one in outputs]
    for channel in pooled:
        if channel is None:
            given.fail("", f"a channel has no sample from {start:g} to {stop:g} s")
    return Recording(tuple(channel for channel in pooled if channel is not None))


def _outputs_from(recording: Recording, given: Arguments) -> Recording:
    if not given.has("outputs_from"):
        return recording
    return select(
        recording, Arguments(f"{given.pointer}/outputs_from", given.value("outputs_from"))
    )


def own_times_of(channel: Channel, segments: tuple[Segment, ...]) -> FloatArray:
    """Times of all samples, each counted in its own segment, to the nanosecond."""
    if not segments:
        return channel.times
    starts = np.array([one.start for one in segments])
    origins = np.array([one.origin for one in segments])
    here = np.searchsorted(starts, channel.times, side="right") - 1
    return np.asarray(np.round(channel.times - starts[here] + origins[here], 9))


def _gathered(
    channel: Channel, segments: tuple[Segment, ...], start: float, stop: float
) -> Channel | None:
    times = own_times_of(channel, segments)
    rows = np.flatnonzero((times >= start) & (times < stop) & np.isfinite(channel.values))
    if rows.size == 0:
        return None
    ordered = rows[np.argsort(times[rows], kind="stable")]
    return replace(channel, times=times[ordered], values=channel.values[ordered], history=None)


def _input(
    channel: Channel, segments: tuple[Segment, ...], start: float, stop: float, width: float
) -> Channel | None:
    """The pooled input; its history is what the repeats recorded before the start."""
    bins = _medians(channel, segments, start, stop, width)
    before = _medians(channel, segments, -np.inf, start, width, first=start)
    if bins is None or before is None:
        return bins
    return bins.after(before)


def _medians(
    channel: Channel, segments: tuple[Segment, ...], start: float, stop: float, width: float,
    first: float | None = None,
) -> Channel | None:  # fmt: skip
    """Medians of the samples from start to stop; a bin begins at `first`, or else at the start."""
    gathered = _gathered(channel, segments, start, stop)
    if gathered is None:
        return None
    bins = _bins(gathered.times, start if first is None else first, width)
    firsts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    medians = np.array([np.median(part) for part in np.split(gathered.values, firsts[1:])])
    counts = np.diff(firsts, append=bins.size)
    # Not the bin's middle: where its samples are few or uneven, that would shift the curve in time.
    means = np.asarray(np.round(np.add.reduceat(gathered.times, firsts) / counts, 9))
    return replace(channel, times=means, values=medians)


def _bins(times: FloatArray, start: float, width: float) -> IntArray:
    # Rounded first: a sample printed as 0.003 s belongs to the bin that begins there.
    return np.floor(np.round((times - start) / width, 6)).astype(np.int64)
