"""All channels of a recording on one regular grid."""

from dataclasses import replace

import numpy as np

from sysid.arguments import Arguments
from sysid.records import Channel, Recording, Segment
from sysid.types import FloatArray

MOST_SAMPLES = 50_000_000


def resample(recording: Recording, given: Arguments) -> Recording:
    """Put every channel on a common grid with the period `sample_time` (s).

    The grid spans what all channels cover; each segment has its own. Method ``linear`` reads
    between the samples (a channel with zero-order hold: the last sample); ``mean`` averages the
    samples of each period, which keeps faster components from being folded into the slow ones.
    """
    given.only("sample_time", "method")
    period = given.positive("sample_time")
    method = given.choice("method", ("linear", "mean"), "linear")
    if recording.duration / period > MOST_SAMPLES:
        given.fail("sample_time", f"found {period!r}; that would be over {MOST_SAMPLES} samples")
    spans = [(one.start, one.stop) for one in recording.segments] or [(-np.inf, np.inf)]
    grids = [_grid([c.between(*span) for c in recording.channels], period) for span in spans]
    for grid in grids:
        if grid.size == 0:
            given.fail("", "the channels share no time")
    times = np.concatenate(grids)
    read = _mean if method == "mean" else _between
    channels = tuple(
        replace(
            one,
            times=times,
            values=np.concatenate(
                [
                    read(one.between(*span), grid, period)
                    for span, grid in zip(spans, grids, strict=True)
                ]
            ),
        )
        for one in recording.channels
    )
    segments = tuple(
        _moved(one, grid) for one, grid in zip(recording.segments, grids, strict=False)
    )
    return Recording(channels, segments)


def _grid(channels: list[Channel], period: float) -> FloatArray:
    start = max(float(one.times[0]) for one in channels)
    stop = min(float(one.times[-1]) for one in channels)
    count = int(np.floor((stop - start) / period + 1e-6)) + 1
    return np.asarray(start + period * np.arange(max(count, 0)), dtype=np.float64)


def _between(channel: Channel, grid: FloatArray, period: float) -> FloatArray:
    if channel.hold == "zero":
        last = np.searchsorted(channel.times, grid + 1e-9 * period, side="right") - 1
        return channel.values[last]
    return np.asarray(np.interp(grid, channel.times, channel.values), dtype=np.float64)


def _mean(channel: Channel, grid: FloatArray, period: float) -> FloatArray:
    here = np.floor((channel.times - grid[0]) / period + 0.5).astype(np.int64)
    inside = (here >= 0) & (here < grid.size)
    counts = np.bincount(here[inside], minlength=grid.size)
    sums = np.bincount(here[inside], weights=channel.values[inside], minlength=grid.size)
    alone = _between(channel, grid, period)  # where a period has no sample of its own
    return np.where(counts > 0, sums / np.maximum(counts, 1), alone)


def _moved(segment: Segment, grid: FloatArray) -> Segment:
    moved = float(grid[0]) - segment.start
    return replace(
        segment, start=float(grid[0]), stop=float(grid[-1]), origin=segment.origin + moved
    )
