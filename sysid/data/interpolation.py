"""Interpolation of inputs onto the fine uniform grid that kernels read."""

from dataclasses import dataclass, replace
from math import ceil
from typing import Literal

import numpy as np

from sysid.core.errors import InvalidRecord
from sysid.core.types import FloatArray
from sysid.data.records import Channel, History, measure_sampling, trim_missing_history

POINTS_PER_SAMPLE = 8
"""Fine points in a sampling period if the signal between samples is not a straight line."""

MAX_POINTS_PER_STEP = 64
"""Most fine points in an integration step."""

_JITTER = 0.05  # of a fine point: rounding error of times with few digits

_PERIOD_TOLERANCE = 0.05  # of a sampling period: deviation that counts as regular
_HALF_WIDTH = 48  # of the band-limited interpolation, in samples
_KAISER = 8.0  # 80 dB


@dataclass(frozen=True, slots=True, eq=False)
class FineInput:
    """An input on the fine grid.

    Attributes
    ----------
    values : FloatArray
    start_index : int
        Index of the value at the start of the simulation.
    points_per_step : int
        Fine points in an integration step.
    begin, end : int
        Where a step begins and ends, in fine points from its start. At a jump the grid holds the
        mean of both sides, so that a delayed jump is not displaced. An input without delay is
        read one point after the jump and one before the next.
    max_delay : int
        Largest delay, in fine points.
    """

    values: FloatArray
    start_index: int
    points_per_step: int
    begin: int
    end: int
    max_delay: int

    def is_placed_as(self, other: "FineInput") -> bool:
        """Whether this input differs from another one in its values only."""
        return self.values.size == other.values.size and all(
            getattr(self, name) == getattr(other, name)
            for name in ("start_index", "points_per_step", "begin", "end", "max_delay")
        )


def interpolate_input(
    channel: Channel,
    start: float,
    step: float,
    steps: int,
    max_delay: float,
    mean: Literal["around", "after"] | None = None,
) -> FineInput:
    """Interpolate an input onto the fine grid.

    A held input with an unknown delay is replaced by its mean over one integration step: `around`
    the time for a solver, `after` it for a recursion. Without the mean, its jumps would fall
    between the points that a step reads. The response would then be a staircase in the delay. The
    mean contains each jump completely, so the response is as smooth in the delay as the plant
    makes it. At whole delays the response is unchanged.

    Before its first sample the input is its history; before that it is its first value.

    Parameters
    ----------
    start, step, steps : float, float, int
        First time of the simulation (s), integration step (s), and number of steps.
    max_delay : float
        Largest delay of the input, in steps.
    mean : {"around", "after"} or None
        Averaging of a held input; None: none.
    """
    channel = _join_usable_history(replace(channel, hold=channel.effective_hold).acting)
    points_per_step = _count_points(channel, start, step)
    points_before = ceil(max_delay * points_per_step) + 2
    count = points_before + (steps + 2) * points_per_step + 2
    times: FloatArray = start + (np.arange(count, dtype=np.float64) - points_before) * (
        step / points_per_step
    )
    if mean is not None and channel.hold == "zero" and channel.times.size > 1:
        advance = 0.5 * step if mean == "around" else 0.0
        values = average_held(channel, times - advance, step)
        return FineInput(
            values, points_before, points_per_step, 0, points_per_step, max(points_before - 2, 0)
        )
    jump = 1 if channel.hold == "zero" else 0
    return FineInput(
        interpolate_channel(channel, times),
        points_before,
        points_per_step,
        jump,
        points_per_step - jump,
        max(points_before - 2, 0),
    )


def _join_usable_history(channel: Channel) -> Channel:
    """Join history and samples; of a band-limited channel only the regular part of the history.

    Band-limited interpolation needs regular samples. A gap in the history must not make a regular
    record unusable.
    """
    recorded = trim_missing_history(channel.history)
    channel = replace(channel, history=recorded)
    if recorded is None or channel.hold != "band-limited":
        return channel.history_and_samples
    period = (channel.times[-1] - channel.times[0]) / max(channel.times.size - 1, 1)
    times, values = recorded
    expected = channel.times[0] - period * np.arange(times.size, 0, -1)
    irregular = np.flatnonzero(np.abs(times - expected) >= 0.5 * _PERIOD_TOLERANCE * period)
    first = int(irregular[-1]) + 1 if irregular.size else 0
    usable = History(times[first:], values[first:]) if first < times.size else None
    return replace(channel, history=usable).history_and_samples


def _count_points(channel: Channel, start: float, step: float) -> int:
    """Count the fine points in a step; even, so that half steps are fine points too."""
    period = estimate_sampling_period(channel)
    if period is None:
        return 2
    if channel.hold == "first":
        for points in range(2, MAX_POINTS_PER_STEP + 1, 2):
            if _is_aligned(channel.times, start, step / points):
                return points
    wanted = min(POINTS_PER_SAMPLE * step / period, MAX_POINTS_PER_STEP)
    return int(np.clip(2 * ceil(wanted / 2 - 1e-3), 4, MAX_POINTS_PER_STEP))


def _is_aligned(times: FloatArray, start: float, spacing: float) -> bool:
    positions = (times - start) / spacing
    return bool(np.max(np.abs(positions - np.round(positions))) < _JITTER)


def estimate_sampling_period(channel: Channel) -> float | None:
    """Estimate the sampling period (s) as a median; None if all times are equal."""
    steps = np.diff(channel.times)
    steps = steps[steps > 0]
    return float(np.median(steps)) if steps.size else None


def interpolate_channel(channel: Channel, times: FloatArray) -> FloatArray:
    """Interpolate a channel by its hold; outside its samples its end values hold."""
    channel = channel.acting
    hold = channel.effective_hold
    if hold == "first" or channel.times.size < 2:
        return np.interp(times, channel.times, channel.values)
    if hold == "zero":
        return _interpolate_held(channel, times)
    return _interpolate_band_limited(channel, times)


def _interpolate_held(channel: Channel, times: FloatArray) -> FloatArray:
    """Read the last sample's value; at a sample's own time the mean of both sides."""
    tolerance = 1e-6 * (estimate_sampling_period(channel) or 1.0)
    last = channel.times.size - 1
    after = np.searchsorted(channel.times, times + tolerance, side="right") - 1
    before = np.searchsorted(channel.times, times - tolerance, side="right") - 1
    values = channel.values
    means: FloatArray = 0.5 * (values[np.clip(after, 0, last)] + values[np.clip(before, 0, last)])
    return means


def average_held(channel: Channel, times: FloatArray, width: float) -> FloatArray:
    """Average a held channel over [t, t + width]: difference of its integral over `width`."""
    values, far = channel.values, width + float(np.ptp(times)) + float(np.ptp(channel.times))
    knots = np.concatenate([[channel.times[0] - far], channel.times, [channel.times[-1] + far]])
    held = np.concatenate([values[:1], values])
    # Relative to the first value, so that a constant stays exact.
    integral = np.concatenate([[0.0], np.cumsum((held - values[0]) * np.diff(knots))])
    rise = np.interp(times + width, knots, integral) - np.interp(times, knots, integral)
    means: FloatArray = values[0] + rise / width
    return means


def _interpolate_band_limited(channel: Channel, times: FloatArray) -> FloatArray:
    """Interpolate by a Kaiser-windowed sinc to `POINTS_PER_SAMPLE`, then by a cubic spline.

    The record is extended at both ends by point reflection, which keeps value and slope.
    """
    # Imported here: it takes most of a second, and few inputs need it.
    from scipy.interpolate import CubicSpline
    from scipy.signal import upfirdn

    sampling = measure_sampling(channel.times, within=_PERIOD_TOLERANCE)
    if not sampling.is_regular:
        raise InvalidRecord(
            f"input {channel.name!r} is to be band-limited between its samples, but its sampling "
            "is irregular; use hold 'first' or resample it"
        )
    reach = np.arange(-_HALF_WIDTH * POINTS_PER_SAMPLE, _HALF_WIDTH * POINTS_PER_SAMPLE + 1)
    kernel = np.sinc(reach / POINTS_PER_SAMPLE) * np.kaiser(reach.size, _KAISER)
    values, margin = channel.values, 2 * _HALF_WIDTH
    extended = np.pad(values, margin, mode="reflect", reflect_type="odd")
    dense = upfirdn(kernel, extended, up=POINTS_PER_SAMPLE)[_HALF_WIDTH * POINTS_PER_SAMPLE :]
    first = (margin - 1) * POINTS_PER_SAMPLE
    dense = dense[first : first + (values.size + 1) * POINTS_PER_SAMPLE + 1]
    points = (np.arange(dense.size) / POINTS_PER_SAMPLE - 1.0) * sampling.period + channel.times[0]
    inside = np.clip(times, channel.times[0], channel.times[-1])
    if dense.size == 0:
        return np.interp(times, channel.times, values)
    interpolated: FloatArray = CubicSpline(points, dense)(inside)
    return interpolated
