"""Selection of repeated measurements (segments), and their pooling into one record."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sysid.core.errors import suggest_name
from sysid.core.types import FloatArray, IntArray
from sysid.data.derivation_arguments import StepArguments
from sysid.data.records import Channel, Recording, Segment

SegmentLabel = float | str
LabelCondition = Callable[[SegmentLabel], bool]


def select_segments(recording: Recording, arguments: StepArguments) -> Recording:
    """Select segments whose labels satisfy every condition; their times stay unchanged.

    A condition is a value, a list of values, ``{"modulus": m, "remainder": r}``, or
    ``{"min": a, "max": b}``.
    """
    if not recording.segments:
        arguments.fail("", "the recording has no segments; name its label columns on upload")
    conditions = {
        name: _parse_condition(name, value, arguments) for name, value in arguments.get_items()
    }
    for name in conditions:
        labels = {label for segment in recording.segments for label in segment.labels}
        if name not in labels:
            arguments.fail(name, f"no segment has such a label{suggest_name(name, labels)}")
    selected = tuple(
        segment
        for segment in recording.segments
        if all(
            name in segment.labels and holds(segment.labels[name])
            for name, holds in conditions.items()
        )
    )
    if not selected:
        arguments.fail(
            "", f"none of the {len(recording.segments)} segments satisfies these conditions"
        )
    is_first = selected[0] is recording.segments[0]
    return Recording(
        tuple(_select_samples(channel, selected, is_first) for channel in recording.channels),
        selected,
    )


def _select_samples(channel: Channel, segments: tuple[Segment, ...], is_first: bool) -> Channel:
    """Select the samples of segments; only the recording's first segment has a history."""
    starts = np.searchsorted(channel.times, [segment.start for segment in segments])
    stops = np.searchsorted(channel.times, [segment.stop for segment in segments], side="right")
    rows = np.concatenate([np.arange(a, b) for a, b in zip(starts, stops, strict=True)])
    history = channel.history if is_first else None
    return replace(channel, times=channel.times[rows], values=channel.values[rows], history=history)


def _parse_condition(name: str, value: Any, arguments: StepArguments) -> LabelCondition:
    if isinstance(value, Mapping):
        inner = StepArguments(f"{arguments.pointer}/{name}", value)
        if inner.has_argument("modulus"):
            return _match_remainder(inner)
        return _match_range(inner)
    wanted = value if isinstance(value, list | tuple) else [value]
    for entry in wanted:
        if isinstance(entry, bool) or not isinstance(entry, int | float | str):
            arguments.fail(name, f"found {entry!r}; need a number or a text")
    return lambda label: label in wanted


def _match_remainder(inner: StepArguments) -> LabelCondition:
    inner.reject_others("modulus", "remainder")
    modulus, remainder = inner.read_positive("modulus"), inner.read_number("remainder")
    return lambda label: isinstance(label, int | float) and label % modulus == remainder


def _match_range(inner: StepArguments) -> LabelCondition:
    inner.reject_others("min", "max")
    least, most = inner.read_number("min", -1e308), inner.read_number("max", 1e308)
    return lambda label: isinstance(label, int | float) and least <= label <= most


def pool_segments(recording: Recording, arguments: StepArguments) -> Recording:
    """Pool all segments into one record, on their own times.

    The input becomes the median of its samples over bins of time, at the mean time of each bin's
    samples. Each output keeps every sample at its own time. This resolves a delay shorter than
    the sampling period if every repeat has another phase. Input samples before ``start`` become
    its history.

    ``outputs_from`` (conditions as in `select_segments`) restricts the outputs to some segments.
    If every repeat has the same input, validation segments may still improve the input.
    """
    arguments.reject_others("input", "outputs", "outputs_from", "bin", "start", "stop")
    start, width = arguments.read_number("start", 0.0), arguments.read_positive("bin")
    source = recording.channel(arguments.read_text("input"))
    selected = _select_output_segments(recording, arguments)
    outputs = [selected.channel(name) for name in arguments.read_texts("outputs")]
    last = max(
        float(compute_segment_times(signal, whole.segments).max())
        for signal, whole in [(source, recording), *((output, selected) for output in outputs)]
    )
    stop = arguments.read_number("stop", float(np.nextafter(last, np.inf)))
    if stop <= start:
        arguments.fail("stop", f"found {stop!r}; need more than the start, {start!r}")
    pooled = [_pool_input(source, recording.segments, start, stop, width)]
    pooled += [_collect_samples(signal, selected.segments, start, stop) for signal in outputs]
    for channel in pooled:
        if channel is None:
            arguments.fail("", f"a channel has no sample from {start:g} to {stop:g} s")
    return Recording(tuple(channel for channel in pooled if channel is not None))


def _select_output_segments(recording: Recording, arguments: StepArguments) -> Recording:
    if not arguments.has_argument("outputs_from"):
        return recording
    return select_segments(
        recording,
        StepArguments(f"{arguments.pointer}/outputs_from", arguments.get_value("outputs_from")),
    )


def compute_segment_times(channel: Channel, segments: tuple[Segment, ...]) -> FloatArray:
    """Compute the times of all samples in their own segments, to the nanosecond."""
    if not segments:
        return channel.times
    starts = np.array([segment.start for segment in segments])
    origins = np.array([segment.origin for segment in segments])
    numbers = np.searchsorted(starts, channel.times, side="right") - 1
    return np.asarray(np.round(channel.times - starts[numbers] + origins[numbers], 9))


def _collect_samples(
    channel: Channel, segments: tuple[Segment, ...], start: float, stop: float
) -> Channel | None:
    times = compute_segment_times(channel, segments)
    repeats = np.searchsorted([one.start for one in segments], channel.times, side="right")
    rows = np.flatnonzero((times >= start) & (times < stop) & np.isfinite(channel.values))
    if rows.size == 0:
        return None
    ordered = rows[np.argsort(times[rows], kind="stable")]
    return replace(
        channel,
        times=times[ordered],
        values=channel.values[ordered],
        history=None,
        started_at=None,  # repeats have no common clock
        repeats=repeats[ordered].astype(np.float64) if segments else None,
    )


def _pool_input(
    channel: Channel, segments: tuple[Segment, ...], start: float, stop: float, width: float
) -> Channel | None:
    """Pool the input; its history is the pooled samples before the start."""
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
    """Compute bin medians from start to stop; a bin begins at `first`, by default the start."""
    samples = _collect_samples(channel, segments, start, stop)
    if samples is None:
        return None
    bins = _assign_bins(samples.times, start if first is None else first, width)
    firsts = np.flatnonzero(np.diff(bins, prepend=bins[0] - 1))
    medians = np.array([np.median(part) for part in np.split(samples.values, firsts[1:])])
    counts = np.diff(firsts, append=bins.size)
    # Not the bin's middle: with few or uneven samples it would shift the curve in time.
    means = np.asarray(np.round(np.add.reduceat(samples.times, firsts) / counts, 9))
    return replace(channel, times=means, values=medians, repeats=None)


def _assign_bins(times: FloatArray, start: float, width: float) -> IntArray:
    # Rounded first: a sample printed as 0.003 s belongs to the bin that begins there.
    return np.floor(np.round((times - start) / width, 6)).astype(np.int64)
