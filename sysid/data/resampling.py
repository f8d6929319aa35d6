"""All channels of a recording on one regular grid."""

from collections.abc import Callable
from dataclasses import replace
from math import floor

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.arguments import StepArguments
from sysid.data.history import INTERPOLATION_MARGIN
from sysid.data.interpolation import average_held
from sysid.data.records import Channel, History, Recording, Segment

MAX_SAMPLES = 50_000_000

_BORDER_TOLERANCE = 1e-6  # of a period: nearer to the border of two, a sample belongs to both
_ROUNDING_TOLERANCE = 1e-9


def resample_recording(recording: Recording, given: StepArguments) -> Recording:
    """Put every channel on a common grid with the period `sample_time` (s).

    The grid spans what all channels cover; each segment has its own. Method ``linear`` reads
    between the samples (a channel with zero-order hold: the last sample, so that its jumps wait
    for the next grid point); ``mean`` averages the samples from half a period before a grid point
    to half a period behind it, which keeps faster components from being folded into the slow ones.
    Of a channel with zero-order hold it is the mean over the period for which it is then held:
    the jumps stay, on average, where they are, and so does a lag behind them.

    The grid goes on backwards through what a channel was before: its history, and where it was
    recorded longer than others what lies before the grid. Of segments only the first has one.
    """
    given.reject_others("sample_time", "method")
    period = given.read_positive("sample_time")
    method = given.read_choice("method", ("linear", "mean"), "linear")
    if recording.duration / period > MAX_SAMPLES:
        given.fail("sample_time", f"found {period!r}, which gives more than {MAX_SAMPLES} samples")
    spans = [(one.start, one.stop) for one in recording.segments] or [(-np.inf, np.inf)]
    grids = [
        _build_grid([c.slice_time(*span) for c in recording.channels], period) for span in spans
    ]
    for grid in grids:
        if grid.size == 0:
            given.fail("", "the channels share no time")
    read = _average_periods if method == "mean" else _interpolate_values
    channels = []
    for one in recording.channels:
        first, *later = [one.slice_time(*span) for span in spans]
        begun = _resample_channel(first, grids[0], period, read)
        values = [begun.values]
        values += [read(part, grid, period) for part, grid in zip(later, grids[1:], strict=True)]
        channels.append(replace(begun, times=np.concatenate(grids), values=np.concatenate(values)))
    segments = tuple(
        _move_segment(one, grid) for one, grid in zip(recording.segments, grids, strict=False)
    )
    return Recording(tuple(channels), segments)


def _resample_channel(
    channel: Channel,
    grid: FloatArray,
    period: float,
    read: Callable[[Channel, FloatArray, float], FloatArray],
) -> Channel:
    """A channel on a grid, and before it as far as anything is known."""
    whole = channel.history_and_samples
    known = max(floor((grid[0] - whole.times[0]) / period + _BORDER_TOLERANCE), 0)
    back = min(known, grid.size + INTERPOLATION_MARGIN)  # no lag is longer than the record
    times = np.concatenate([grid[0] - period * np.arange(back, 0, -1), grid])
    values = read(whole, times, period)
    history = History(times[:back], values[:back]) if back else None
    return replace(channel, times=grid, values=values[back:], history=history)


def _build_grid(channels: list[Channel], period: float) -> FloatArray:
    start = max(float(one.times[0]) for one in channels)
    stop = min(float(one.times[-1]) for one in channels)
    count = int(np.floor((stop - start) / period + 1e-6)) + 1
    return np.asarray(start + period * np.arange(max(count, 0)), dtype=np.float64)


def _interpolate_values(channel: Channel, grid: FloatArray, period: float) -> FloatArray:
    if channel.hold == "zero":
        last = np.searchsorted(channel.times, grid + 1e-9 * period, side="right") - 1
        return channel.values[np.maximum(last, 0)]  # a history may begin by rounding before it
    return np.asarray(np.interp(grid, channel.times, channel.values), dtype=np.float64)


def _average_periods(channel: Channel, grid: FloatArray, period: float) -> FloatArray:
    if channel.hold == "zero":
        return _average_held_periods(channel, grid, period)
    places = (channel.times - grid[0]) / period + 0.5
    counts, sums = np.zeros(grid.size), np.zeros(grid.size)
    # A sample on the border of two periods is half of either: else the mean would lie too early.
    for border in (-_BORDER_TOLERANCE, _BORDER_TOLERANCE):
        here = np.floor(places + border).astype(np.int64)
        inside = (here >= 0) & (here < grid.size)
        counts += np.bincount(here[inside], minlength=grid.size)
        sums += np.bincount(here[inside], weights=channel.values[inside], minlength=grid.size)
    alone = _interpolate_values(channel, grid, period)  # where a period has no sample of its own
    return np.where(counts > 0, sums / np.maximum(counts, 1), alone)


def _average_held_periods(channel: Channel, grid: FloatArray, period: float) -> FloatArray:
    """Mean from each grid point to the next; unknown where any of it is."""
    missing = ~np.isfinite(channel.values)
    known = replace(channel, values=np.where(missing, 0.0, channel.values))
    means = average_held(known, grid, period)
    last = _interpolate_values(known, grid, period)
    # Where nothing jumps it is the value itself, to its last digit.
    means = np.where(
        np.abs(means - last) <= _ROUNDING_TOLERANCE * np.ptp(known.values), last, means
    )
    gaps = average_held(replace(channel, values=missing.astype(np.float64)), grid, period)
    return np.where(gaps > _ROUNDING_TOLERANCE, np.nan, means)


def _move_segment(segment: Segment, grid: FloatArray) -> Segment:
    moved = float(grid[0]) - segment.start
    return replace(
        segment, start=float(grid[0]), stop=float(grid[-1]), origin=segment.origin + moved
    )
