"""Inputs between their samples: each is laid once onto a fine uniform grid that kernels read."""

from dataclasses import dataclass, replace
from math import ceil
from typing import Literal

import numpy as np

from sysid.core.errors import InvalidRecord
from sysid.core.types import FloatArray
from sysid.data.records import Channel, History, measure_sampling, trim_missing_history

POINTS_PER_SAMPLE = 8
"""Fine points in a sampling period where the signal between samples is not a straight line."""

MAX_POINTS_PER_STEP = 64
"""Fine points in an integration step at most."""

_JITTER = 0.05  # of a fine point, that times written with few digits are off

_PERIOD_TOLERANCE = 0.05  # of a sampling period, that samples count as regular
_HALF_WIDTH = 48  # of the band-limited interpolation, in samples
_KAISER = 8.0  # 80 dB


@dataclass(frozen=True, slots=True, eq=False)
class FineInput:
    """An input on the fine grid.

    Attributes
    ----------
    values : FloatArray
    zero : int
        Index of the value at the start of the simulation.
    points : int
        Fine points in an integration step.
    begin, end : int
        Where a step begins and ends, in fine points from its start. At a jump the grid holds the
        mean of both sides, so that a lagged jump is not displaced; an input without lag is read
        one point behind the jump and one before it.
    cap : int
        Fine points before the start.
    """

    values: FloatArray
    start_index: int
    points_per_step: int
    begin: int
    end: int
    max_delay: int


def interpolate_input(
    channel: Channel,
    start: float,
    step: float,
    steps: int,
    lag: float,
    mean: Literal["around", "after"] | None = None,
) -> FineInput:
    """Lay an input onto the fine grid.

    A held input that is read with an unknown lag is given as its mean over one integration step,
    `around` the time for a solver, `after` it for a recursion. Read as it is, its jumps would fall
    between the places that a step looks at, and the response would be a staircase in the lag. The
    mean over a step enters whole, however the jump lies: the response is as smooth in the lag as
    the plant makes it, and at whole lags it is what it was.

    Before its first sample the input is what its history says, and before that its first value.

    Parameters
    ----------
    start, step, steps : float, float, int
        First time of the simulation, its integration step, both in s, and how many steps follow.
    lag : float
        Largest lag with which the input is read, in steps.
    mean : {"around", "after"} or None
        How a held input is averaged; None: it is not.
    """
    channel = _join_usable_history(channel)
    points = _count_points(channel, start, step)
    cap = ceil(lag * points) + 2
    count = cap + (steps + 2) * points + 2
    times: FloatArray = start + (np.arange(count, dtype=np.float64) - cap) * (step / points)
    if mean is not None and channel.hold == "zero" and channel.times.size > 1:
        early = 0.5 * step if mean == "around" else 0.0
        values = average_held(channel, times - early, step)
        return FineInput(values, cap, points, 0, points, max(cap - 2, 0))
    jump = 1 if channel.hold == "zero" else 0
    return FineInput(
        interpolate_channel(channel, times), cap, points, jump, points - jump, max(cap - 2, 0)
    )


def _join_usable_history(channel: Channel) -> Channel:
    """Known history and samples together; of a band-limited channel what keeps its period.

    Between irregular samples nothing is band-limited, and a gap in what was recorded before must
    not make a record useless that is regular itself.
    """
    known = trim_missing_history(channel.history)
    channel = replace(channel, history=known)
    if known is None or channel.hold != "band-limited":
        return channel.history_and_samples
    period = (channel.times[-1] - channel.times[0]) / max(channel.times.size - 1, 1)
    times, values = known
    expected = channel.times[0] - period * np.arange(times.size, 0, -1)
    off = np.flatnonzero(np.abs(times - expected) >= 0.5 * _PERIOD_TOLERANCE * period)
    first = int(off[-1]) + 1 if off.size else 0
    usable = History(times[first:], values[first:]) if first < times.size else None
    return replace(channel, history=usable).history_and_samples


def _count_points(channel: Channel, start: float, step: float) -> int:
    """Fine points in a step: an even number, so that half steps are fine points too."""
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
    places = (times - start) / spacing
    return bool(np.max(np.abs(places - np.round(places))) < _JITTER)


def estimate_sampling_period(channel: Channel) -> float | None:
    """Median distance of neighbouring samples in s; None if no two have different times."""
    steps = np.diff(channel.times)
    steps = steps[steps > 0]
    return float(np.median(steps)) if steps.size else None


def interpolate_channel(channel: Channel, times: FloatArray) -> FloatArray:
    """Values of a channel at any times, by its hold; its end values outside its samples."""
    if channel.hold == "first" or channel.times.size < 2:
        return np.interp(times, channel.times, channel.values)
    if channel.hold == "zero":
        return _interpolate_held(channel, times)
    return _interpolate_band_limited(channel, times)


def _interpolate_held(channel: Channel, times: FloatArray) -> FloatArray:
    """The last sample's value; the mean of both sides where the time is a sample's own."""
    tolerance = 1e-6 * (estimate_sampling_period(channel) or 1.0)
    last = channel.times.size - 1
    after = np.searchsorted(channel.times, times + tolerance, side="right") - 1
    before = np.searchsorted(channel.times, times - tolerance, side="right") - 1
    values = channel.values
    found: FloatArray = 0.5 * (values[np.clip(after, 0, last)] + values[np.clip(before, 0, last)])
    return found


def average_held(channel: Channel, times: FloatArray, width: float) -> FloatArray:
    """Mean of a held channel over [t, t + width]: the difference of its integral, by `width`."""
    values, far = channel.values, width + float(np.ptp(times)) + float(np.ptp(channel.times))
    knots = np.concatenate([[channel.times[0] - far], channel.times, [channel.times[-1] + far]])
    held = np.concatenate([values[:1], values])
    # Counted from the first value, so that a constant stays exactly that.
    integral = np.concatenate([[0.0], np.cumsum((held - values[0]) * np.diff(knots))])
    rise = np.interp(times + width, knots, integral) - np.interp(times, knots, integral)
    found: FloatArray = values[0] + rise / width
    return found


def _interpolate_band_limited(channel: Channel, times: FloatArray) -> FloatArray:
    """Kaiser-windowed sinc to `POINTS_PER_SAMPLE` points a sample, then a cubic spline through those.

    The record is continued at both ends by its point reflection, which keeps value and slope.
    """
    # Here, as they take most of a second to import and few inputs need them.
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
    places = (np.arange(dense.size) / POINTS_PER_SAMPLE - 1.0) * sampling.period + channel.times[0]
    inside = np.clip(times, channel.times[0], channel.times[-1])
    if dense.size == 0:
        return np.interp(times, channel.times, values)
    found: FloatArray = CubicSpline(places, dense)(inside)
    return found
