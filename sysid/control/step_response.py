"""Measures of a step response: rise time, overshoot, settling, and integrals of the error."""

from dataclasses import dataclass
from math import isfinite, nan

import numpy as np

from sysid.core.errors import InvalidRecord
from sysid.core.types import FloatArray

_RISE_LEVELS = (0.1, 0.9)
_SETTLING_BAND = 0.02
_TAIL_SHARE = 0.1
_N_WINDOWS = 3  # the last quarters of the record: the first one contains the step itself
_PEAK_GROWTH = 1.03  # a limit cycle's peaks differ by less, because of the sampling
_SWING_GROWTH = 1.01  # the same for swings between interpolated turning points
_LASTING_SHARE = 0.9  # of the swing two quarters before: one that decays faster will settle
_STEADY_GROWTH = 0.99  # of the last increment: above it, growth does not slow down
_RESPONSE_ROUNDING = 1e-9  # of the step: an output that moves less has not responded
_DIVERGENCE_LIMIT = 1e100  # steps away from the reference: larger values cannot be squared


@dataclass(frozen=True, slots=True)
class StepMetrics:
    """Measures of a step response; times in s after the step, ``nan`` if undefined.

    Attributes
    ----------
    rise_time : float
        From 10 % to 90 % of the change from the initial to the final value.
    overshoot_percent : float
        Largest excess over the reference, in per cent of the step; 0 if it is not passed.
    overshoot_of_final_percent : float
        Largest excess over the final value, in per cent of the change from the initial value. It
        is useful if a steady error keeps the output from the reference.
    settling_time : float
        Time from which the output stays within `band` of its mean over the last tenth of the
        record. ``nan`` if it leaves the band within that tenth.
    band : float
        2 % of the step, in the unit of the output.
    steady_error : float
        Reference minus that mean, in the unit of the output.
    final_value : float
        That mean.
    runs_away : bool
        Whether the output is not finite, or its deviation or swing grows from each quarter of the
        record to the next without slowing down. The loop is unstable then. Overshoot, settling
        time and final value are ``nan``.
    is_settled : bool
        Whether there is a settling time. A response that neither runs away nor has settled still
        moves at the end of the record. Its final value and overshoot are those of the record.
    iae, itae : float
        ∫|e| dt and ∫t |e| dt of the error e = reference - output, from the step to the end of the
        record. In the unit of the output times s and s². A steady error makes both grow with it.
    swing, swing_period : float
        Amplitude from peak to peak, in the unit of the output, and period in s of a sustained
        oscillation, as in a limit cycle. ``nan`` if the output settles or runs away, or if the
        record is too short.
    """

    rise_time: float
    overshoot_percent: float
    overshoot_of_final_percent: float
    settling_time: float
    band: float
    steady_error: float
    final_value: float
    runs_away: bool = False
    is_settled: bool = True
    iae: float = nan
    itae: float = nan
    swing: float = nan
    swing_period: float = nan


def measure_step_response(
    times: FloatArray, values: FloatArray, *, at: float, before: float, after: float
) -> StepMetrics:
    """Measure the response to a reference that steps once.

    Parameters
    ----------
    times, values : FloatArray, shape (N,)
        The output; times in s.
    at : float
        Time of the step in s.
    before, after : float
        The reference before and after it, in the unit of the output.

    Raises
    ------
    InvalidRecord
        If no two samples follow the step, or the reference does not change.
    """
    later = times >= at
    if np.count_nonzero(later) < 2:
        raise InvalidRecord(f"the record has fewer than two samples after the step at {at:g} s")
    height = after - before
    if height == 0:
        raise InvalidRecord(f"the reference does not change at {at:g} s")
    t, y = times[later] - at, values[later]
    band = _SETTLING_BAND * abs(height)
    if _runs_away(t, y - after, abs(height)):
        return StepMetrics(nan, nan, nan, nan, band, nan, nan, runs_away=True, is_settled=False)
    tail = t >= t[-1] - _TAIL_SHARE * (t[-1] - t[0])
    final = float(np.mean(y[tail]))
    # A steady error keeps the output from the reference both before and after the step.
    start = float(values[~later][-1]) if not later.all() else float(y[0])
    if abs(final - start) <= _RESPONSE_ROUNDING * abs(height):
        start = final
    settling = _measure_settling_time(t, np.abs(y - final), band, float(t[tail][0]))
    error = np.abs(after - y)
    swing, period = (nan, nan) if isfinite(settling) else _measure_limit_cycle(t, y - after, band)
    return StepMetrics(
        rise_time=_measure_rise_time(t, y, start, final),
        overshoot_percent=_measure_overshoot(y, before, after),
        overshoot_of_final_percent=_measure_overshoot(y, start, final),
        settling_time=settling,
        band=band,
        steady_error=after - final,
        final_value=final,
        is_settled=isfinite(settling),
        iae=float(np.trapezoid(error, t)),
        itae=float(np.trapezoid(t * error, t)),
        swing=swing,
        swing_period=period,
    )


def _measure_rise_time(t: FloatArray, y: FloatArray, before: float, final: float) -> float:
    if final == before:
        return nan
    low, high = (
        _find_level_crossing(t, (y - before) / (final - before), level) for level in _RISE_LEVELS
    )
    return high - low


def _measure_overshoot(y: FloatArray, before: float, end: float) -> float:
    """Largest excess over `end` in per cent of the change; ``nan`` if there is no change."""
    if end == before:
        return nan
    return 100.0 * max(float(np.max((y - before) / (end - before))) - 1.0, 0.0)


def _runs_away(t: FloatArray, deviation: FloatArray, height: float) -> bool:
    """Whether the output is not finite, or its deviation or swing keeps growing.

    A response that is only late, slow, or off in the end slows down or turns towards its end.
    """
    with np.errstate(over="ignore"):
        away = np.abs(deviation)
    if not np.all(away < _DIVERGENCE_LIMIT * height):
        return True
    edges = _compute_window_edges(t)
    farthest = _find_window_maxima(t, away, edges)
    before = max(float(np.max(away[t <= edges[-2]])), height)
    if float(farthest[-1]) > _PEAK_GROWTH * before and _is_growing(farthest, 1.0):
        return True
    swings = _find_window_maxima(*_measure_swings(t, deviation), edges)
    return float(swings[-1]) > _SETTLING_BAND * height and _is_growing(swings, _SWING_GROWTH)


def _measure_limit_cycle(t: FloatArray, deviation: FloatArray, band: float) -> tuple[float, float]:
    """Measure size and period of a swing that neither grows nor decays; ``nan`` if none."""
    ends, sizes = _measure_swings(t, deviation)
    first, *_, last = _find_window_maxima(ends, sizes, _compute_window_edges(t))
    if not last > 2.0 * band or not last > _LASTING_SHARE * first > 0.0:
        return nan, nan
    later = ends[ends > 0.5 * (t[0] + t[-1])]
    return (float(last), 2.0 * float(np.mean(np.diff(later)))) if later.size > 2 else (nan, nan)


def _compute_window_edges(t: FloatArray) -> FloatArray:
    """Compute the ends of the quarters of the record, beginning with the first."""
    edges: FloatArray = t[0] + (t[-1] - t[0]) * np.arange(1, _N_WINDOWS + 2) / (_N_WINDOWS + 1)
    return edges


def _find_window_maxima(t: FloatArray, values: FloatArray, edges: FloatArray) -> FloatArray:
    """Find the largest value in each window (_N_WINDOWS,); 0 if there is none."""
    which = np.searchsorted(edges, t, side="left")  # 0: before the first window
    return np.array([np.max(values[which == i], initial=0.0) for i in range(1, _N_WINDOWS + 1)])


def _is_growing(sizes: FloatArray, least: float) -> bool:
    """Whether each of the sizes is `least` times the one before, and growth does not slow down."""
    if not np.all(sizes[:-1] > 0.0) or not np.all(sizes[1:] > least * sizes[:-1]):
        return False
    increments = np.diff(sizes)
    return bool(np.all(increments[1:] >= _STEADY_GROWTH * increments[:-1]))


def _measure_swings(t: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Measure the swings between turning points: the end time and size of each.

    Parabolas through three samples give the values at turning points. With the samples alone, the
    swings of a limit cycle would seem to grow.
    """
    slope = np.diff(y)
    turning = np.flatnonzero(slope[:-1] * slope[1:] < 0.0) + 1
    bend = slope[turning] - slope[turning - 1]
    peaks = y[turning] - (slope[turning] + slope[turning - 1]) ** 2 / (8.0 * bend)
    return t[turning[1:]], np.abs(np.diff(peaks))


def _find_level_crossing(t: FloatArray, progress: FloatArray, level: float) -> float:
    """Find when the progress first reaches a level, by linear interpolation."""
    reached = np.flatnonzero(progress >= level)
    if reached.size == 0:
        return nan
    i = int(reached[0])
    if i == 0:
        return float(t[0])
    part = (level - progress[i - 1]) / (progress[i] - progress[i - 1])
    return float(t[i - 1] + part * (t[i] - t[i - 1]))


def _measure_settling_time(t: FloatArray, away: FloatArray, band: float, latest: float) -> float:
    """Measure from when on it stays inside the band; ``nan`` if later than `latest`."""
    outside = np.flatnonzero(away > band)
    if outside.size == 0:
        return 0.0
    last = int(outside[-1])
    return nan if last + 1 >= t.size or t[last + 1] > latest else float(t[last + 1])
