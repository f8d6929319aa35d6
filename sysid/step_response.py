"""What a step response is judged by: rise time, overshoot, settling time, steady error."""

from dataclasses import dataclass
from math import nan

import numpy as np

from sysid.errors import InvalidRecord
from sysid.types import FloatArray

_RISE = (0.1, 0.9)
_BAND = 0.02
_TAIL = 0.1
_END, _GROWTH = 0.25, 1.03  # a limit cycle's peaks differ by less, by where the samples lie


@dataclass(frozen=True, slots=True)
class StepMetrics:
    """Measures of a step response; times in s after the step, ``nan`` where there is none.

    Attributes
    ----------
    rise_time : float
        From 10 % to 90 % of the way to the reference.
    overshoot_percent : float
        Farthest way beyond the reference, in per cent of the step; 0 if it is not passed.
    settling_time : float
        From when on the output stays within `band` of its mean over the last tenth of the record.
    band : float
        2 % of the step, in the unit of the output.
    steady_error : float
        Reference minus that mean, in the unit of the output.
    final_value : float
        That mean.
    runs_away : bool
        The output is not finite, or farther from the reference in the last quarter of the record
        than ever before: the loop is unstable, and there is no overshoot, settling time or final
        value; they are ``nan``.
    """

    rise_time: float
    overshoot_percent: float
    settling_time: float
    band: float
    steady_error: float
    final_value: float
    runs_away: bool = False


def step_metrics(
    times: FloatArray, values: FloatArray, *, at: float, before: float, after: float
) -> StepMetrics:
    """Judge the response to a reference that steps once.

    Parameters
    ----------
    times, values : FloatArray, shape (N,)
        The output; times in s.
    at : float
        Time of the step in s.
    before, after : float
        The reference on either side of it, in the unit of the output.

    Raises
    ------
    InvalidRecord
        If no two samples follow the step, or the reference does not change.
    """
    later = times >= at
    if np.count_nonzero(later) < 2:
        raise InvalidRecord(f"the record has no two samples after the step at {at:g} s")
    height = after - before
    if height == 0:
        raise InvalidRecord(f"the reference does not change at {at:g} s")
    t, y = times[later] - at, values[later]
    way = (y - before) / height
    low, high = (_first_passing(t, way, level) for level in _RISE)
    band = _BAND * abs(height)
    if _runs_away(t, np.abs(y - after), abs(height)):
        return StepMetrics(high - low, nan, nan, band, nan, nan, runs_away=True)
    tail = t >= t[-1] - _TAIL * (t[-1] - t[0])
    final = float(np.mean(y[tail]))
    return StepMetrics(
        rise_time=high - low,
        overshoot_percent=100.0 * max(float(np.max(way)) - 1.0, 0.0),
        settling_time=_settled(t, np.abs(y - final), band),
        band=band,
        steady_error=after - final,
        final_value=final,
    )


def _runs_away(t: FloatArray, away: FloatArray, height: float) -> bool:
    """Whether the output is not finite, or leaves the reference farther and farther behind."""
    if not np.all(np.isfinite(away)):
        return True
    late = t > t[-1] - _END * (t[-1] - t[0])
    if late.all():
        return False
    before = max(float(np.max(away[~late])), height)
    return float(np.max(away[late])) > _GROWTH * before


def _first_passing(t: FloatArray, way: FloatArray, level: float) -> float:
    """When the way first reaches a level, on a line between samples."""
    reached = np.flatnonzero(way >= level)
    if reached.size == 0:
        return nan
    i = int(reached[0])
    if i == 0:
        return float(t[0])
    part = (level - way[i - 1]) / (way[i] - way[i - 1])
    return float(t[i - 1] + part * (t[i] - t[i - 1]))


def _settled(t: FloatArray, away: FloatArray, band: float) -> float:
    """From when on it stays inside the band; ``nan`` if the last sample is outside."""
    outside = np.flatnonzero(away > band)
    if outside.size == 0:
        return 0.0
    last = int(outside[-1])
    return nan if last + 1 >= t.size else float(t[last + 1])
