"""Resampling of all channels of a recording onto one regular grid."""

from collections.abc import Callable
from dataclasses import replace
from math import floor

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.derivation_arguments import StepArguments
from sysid.data.history import INTERPOLATION_MARGIN
from sysid.data.interpolation import average_held
from sysid.data.records import Channel, History, Recording, Segment

MAX_SAMPLES = 50_000_000

_BORDER_TOLERANCE = 1e-6  # of a period: nearer to a border, a sample belongs to both periods
_ROUNDING_TOLERANCE = 1e-9


def resample_recording(recording: Recording, arguments: StepArguments) -> Recording:
    """Put every channel on a common grid with the period `sample_time` (s).

    The grid spans the time that all channels cover; each segment has its own grid.

    Method ``linear`` interpolates linearly. A channel with zero-order hold is read at its last
    sample, so its jumps move to the next grid point.

    Method ``mean`` averages from half a period before a grid point to half a period after it.
    This avoids aliasing. A channel with zero-order hold is averaged over the period for which the
    value is then held. Its jumps, and delays after them, are right on average.

    A hold that is chosen by the values is chosen before, and kept. Means of periods become held
    values.

    The grid extends backwards through a channel's earlier samples: its history, and samples
    before the grid. Only the first segment has a history.
    """
    arguments.reject_others("sample_time", "method")
    period = arguments.read_positive("sample_time")
    method = arguments.read_choice("method", ("linear", "mean"), "linear")
    if recording.duration / period > MAX_SAMPLES:
        arguments.fail(
            "sample_time", f"found {period!r}, which gives more than {MAX_SAMPLES} samples"
        )
    spans = [(channel.start, channel.stop) for channel in recording.segments] or [(-np.inf, np.inf)]
    grids = [
        _build_grid([c.slice_time(*span) for c in recording.channels], period) for span in spans
    ]
    for grid in grids:
        if grid.size == 0:
            arguments.fail("", "the channels share no time")
    read = _average_periods if method == "mean" else _interpolate_values
    channels = []
    for recorded in recording.channels:
        channel = replace(recorded, hold=recorded.effective_hold).acting
        first, *later = [channel.slice_time(*span) for span in spans]
        begun = _resample_channel(first, grids[0], period, read)
        values = [begun.values]
        values += [read(part, grid, period) for part, grid in zip(later, grids[1:], strict=True)]
        channels.append(replace(begun, times=np.concatenate(grids), values=np.concatenate(values)))
    segments = tuple(
        _move_segment(channel, grid)
        for channel, grid in zip(recording.segments, grids, strict=False)
    )
    return replace(recording, channels=tuple(channels), segments=segments)


def _resample_channel(
    channel: Channel,
    grid: FloatArray,
    period: float,
    read: Callable[[Channel, FloatArray, float], FloatArray],
) -> Channel:
    """Resample a channel on a grid, and its earlier samples as history."""
    whole = channel.history_and_samples
    available = max(floor((grid[0] - whole.times[0]) / period + _BORDER_TOLERANCE), 0)
    back = min(available, grid.size + INTERPOLATION_MARGIN)  # no delay is longer than the record
    times = np.concatenate([grid[0] - period * np.arange(back, 0, -1), grid])
    values = read(whole, times, period)
    history = History(times[:back], values[:back]) if back else None
    return replace(channel, times=grid, values=values[back:], history=history, repeats=None)


def _build_grid(channels: list[Channel], period: float) -> FloatArray:
    start = max(float(channel.times[0]) for channel in channels)
    stop = min(float(channel.times[-1]) for channel in channels)
    count = int(np.floor((stop - start) / period + 1e-6)) + 1
    return np.asarray(start + period * np.arange(max(count, 0)), dtype=np.float64)


def _interpolate_values(channel: Channel, grid: FloatArray, period: float) -> FloatArray:
    if channel.hold == "zero":
        last = np.searchsorted(channel.times, grid + 1e-9 * period, side="right") - 1
        return channel.values[
            np.maximum(last, 0)
        ]  # by rounding, a history may begin before the samples
    return np.asarray(np.interp(grid, channel.times, channel.values), dtype=np.float64)


def _average_periods(channel: Channel, grid: FloatArray, period: float) -> FloatArray:
    if channel.hold == "zero":
        return _average_held_periods(channel, grid, period)
    positions = (channel.times - grid[0]) / period + 0.5
    counts, sums = np.zeros(grid.size), np.zeros(grid.size)
    # A sample on the border of two periods counts half in each; otherwise the mean is too early.
    for border in (-_BORDER_TOLERANCE, _BORDER_TOLERANCE):
        numbers = np.floor(positions + border).astype(np.int64)
        inside = (numbers >= 0) & (numbers < grid.size)
        counts += np.bincount(numbers[inside], minlength=grid.size)
        sums += np.bincount(numbers[inside], weights=channel.values[inside], minlength=grid.size)
    interpolated = _interpolate_values(channel, grid, period)  # for periods without a sample
    return np.where(counts > 0, sums / np.maximum(counts, 1), interpolated)


def _average_held_periods(channel: Channel, grid: FloatArray, period: float) -> FloatArray:
    """Average from each grid point to the next; nan if any value in between is missing."""
    missing = ~np.isfinite(channel.values)
    filled = replace(channel, values=np.where(missing, 0.0, channel.values))
    means = average_held(filled, grid, period)
    last = _interpolate_values(filled, grid, period)
    # Without a jump the result is exactly the value.
    means = np.where(
        np.abs(means - last) <= _ROUNDING_TOLERANCE * np.ptp(filled.values), last, means
    )
    gaps = average_held(replace(channel, values=missing.astype(np.float64)), grid, period)
    return np.where(gaps > _ROUNDING_TOLERANCE, np.nan, means)


def _move_segment(segment: Segment, grid: FloatArray) -> Segment:
    moved = float(grid[0]) - segment.start
    return replace(
        segment, start=float(grid[0]), stop=float(grid[-1]), origin=segment.origin + moved
    )
