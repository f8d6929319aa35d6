"""Repeats of a measurement: choosing some of them, and pooling them into one record."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.core.errors import suggest_name
from sysid.core.types import FloatArray, IntArray
from sysid.data.arguments import StepArguments
from sysid.data.records import Channel, Recording, Segment

SegmentLabel = float | str
LabelCondition = Callable[[SegmentLabel], bool]


def select_segments(recording: Recording, given: StepArguments) -> Recording:
    """Segments whose labels satisfy every condition; they keep their place on the time axis.

    A condition is a value, a list of values, ``{"modulus": m, "remainder": r}``, or
    ``{"min": a, "max": b}``.
    """
    if not recording.segments:
        given.fail("", "the recording has no segments; name its label columns on upload")
    conditions = {name: _parse_condition(name, value, given) for name, value in given.get_items()}
    for name in conditions:
        known = {label for segment in recording.segments for label in segment.labels}
        if name not in known:
            given.fail(name, f"no segment has such a label{suggest_name(name, known)}")
    kept = tuple(
        segment
        for segment in recording.segments
        if all(
            name in segment.labels and holds(segment.labels[name])
            for name, holds in conditions.items()
        )
    )
    if not kept:
        given.fail("", f"none of the {len(recording.segments)} segments satisfies these conditions")
    is_first = kept[0] is recording.segments[0]
    return Recording(
        tuple(_select_samples(one, kept, is_first) for one in recording.channels), kept
    )


def _select_samples(channel: Channel, kept: tuple[Segment, ...], is_first: bool) -> Channel:
    """Samples of the segments; the history is that of the first one of the recording."""
    starts = np.searchsorted(channel.times, [one.start for one in kept])
    stops = np.searchsorted(channel.times, [one.stop for one in kept], side="right")
    rows = np.concatenate([np.arange(a, b) for a, b in zip(starts, stops, strict=True)])
    history = channel.history if is_first else None
    return replace(channel, times=channel.times[rows], values=channel.values[rows], history=history)


def _parse_condition(name: str, value: Any, given: StepArguments) -> LabelCondition:
    if isinstance(value, Mapping):
        inner = StepArguments(f"{given.pointer}/{name}", value)
        if inner.has_argument("modulus"):
            return _match_remainder(inner)
        return _match_range(inner)
    wanted = value if isinstance(value, list | tuple) else [value]
    for one in wanted:
        if isinstance(one, bool) or not isinstance(one, int | float | str):
            given.fail(name, f"found {one!r}; need a number or a text")
    return lambda label: label in wanted


def _match_remainder(inner: StepArguments) -> LabelCondition:
    inner.reject_others("modulus", "remainder")
    modulus, remainder = inner.read_positive("modulus"), inner.read_number("remainder")
    return lambda label: isinstance(label, int | float) and label % modulus == remainder


def _match_range(inner: StepArguments) -> LabelCondition:
    inner.reject_others("min", "max")
    least, most = inner.read_number("min", -1e308), inner.read_number("max", 1e308)
    return lambda label: isinstance(label, int | float) and least <= label <= most


def pool_segments(recording: Recording, given: StepArguments) -> Recording:
    """One record of all segments, on their own times.

    The input becomes the median of its samples over bins of time, at the mean time of each bin's
    samples; each output keeps every sample at its own time. This resolves a lag that is shorter
    than the sampling period when every repeat has another phase. What the input was before
    ``start`` is its history.

    With ``outputs_from``, conditions as in `select_segments`, outputs are those of some segments
    only: where every repeat has the same input, those kept for validation may help to tell it.
    """
    given.reject_others("input", "outputs", "outputs_from", "bin", "start", "stop")
    start, width = given.read_number("start", 0.0), given.read_positive("bin")
    source = recording.channel(given.read_text("input"))
    kept = _select_output_segments(recording, given)
    outputs = [kept.channel(name) for name in given.read_texts("outputs")]
    last = max(
        float(compute_segment_times(one, whole.segments).max())
        for one, whole in [(source, recording), *((output, kept) for output in outputs)]
    )
    stop = given.read_number("stop", float(np.nextafter(last, np.inf)))
    if stop <= start:
        given.fail("stop", f"found {stop!r}; need more than the start, {start!r}")
    pooled = [_pool_input(source, recording.segments, start, stop, width)]
    pooled += [_collect_samples(one, kept.segments, start, stop) for one in outputs]
    for channel in pooled:
        if channel is None:
            given.fail("", f"a channel has no sample from {start:g} to {stop:g} s")
    return Recording(tuple(channel for channel in pooled if channel is not None))


def _select_output_segments(recording: Recording, given: StepArguments) -> Recording:
    if not given.has_argument("outputs_from"):
        return recording
    return select_segments(
        recording, StepArguments(f"{given.pointer}/outputs_from", given.get_value("outputs_from"))
    )


def compute_segment_times(channel: Channel, segments: tuple[Segment, ...]) -> FloatArray:
    """Times of all samples, each counted in its own segment, to the nanosecond."""
    if not segments:
        return channel.times
    starts = np.array([one.start for one in segments])
    origins = np.array([one.origin for one in segments])
    here = np.searchsorted(starts, channel.times, side="right") - 1
    return np.asarray(np.round(channel.times - starts[here] + origins[here], 9))


def _collect_samples(
    channel: Channel, segments: tuple[Segment, ...], start: float, stop: float
) -> Channel | None:
    times = compute_segment_times(channel, segments)
    rows = np.flatnonzero((times >= start) & (times < stop) & np.isfinite(channel.values))
    if rows.size == 0:
        return None
    ordered = rows[np.argsort(times[rows], kind="stable")]
    return replace(channel, times=times[ordered], values=channel.values[ordered], history=None)


def _pool_input(
    channel: Channel, segments: tuple[Segment, ...], start: float, stop: float, width: float
) -> Channel | None:
    """The pooled input; its history is what the repeats recorded before the start."""
    bins = _compute_bin_medians(channel, segments, start, stop, width)
    before = _compute_bin_medians(channel, segments, -np.inf, start, width, first=start)
    if bins is None or before is None:
        return bins
    return bins.prepend_history(before)


def _compute_bin_medians(
    channel: Channel,
    segments: tuple[Segment, ...],
    start: float,
    stop: float,
    width: float,
    first: float | None = None,
) -> Channel | None:
    """Medians of the samples from start to stop; a bin begins at `first`, or else at the start."""
    gathered = _collect_samples(channel, segments, start, stop)
    if gathered is None:
        return None
    bins = _assign_bins(gathered.times, start if first is None else first, width)
    firsts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    medians = np.array([np.median(part) for part in np.split(gathered.values, firsts[1:])])
    counts = np.diff(firsts, append=bins.size)
    # Not the bin's middle: where its samples are few or uneven, that would shift the curve in time.
    means = np.asarray(np.round(np.add.reduceat(gathered.times, firsts) / counts, 9))
    return replace(channel, times=means, values=medians)


def _assign_bins(times: FloatArray, start: float, width: float) -> IntArray:
    # Rounded first: a sample printed as 0.003 s belongs to the bin that begins there.
    return np.floor(np.round((times - start) / width, 6)).astype(np.int64)
