"""Resampling: values on straight lines between fewer ones, which alone were measured."""

from collections.abc import Iterator

import numpy as np

from sysid.core.findings import Finding
from sysid.core.types import BoolArray, FloatArray
from sysid.inspection.signal import Signal, build_finding

_LINE_SHARE = 1e-6  # of the range: a bend
_DRAWN_SHARE = 0.1  # of the samples that lie on lines; of measured ones none does
_ONE_STEP, _PILED = 1.5, 3.0  # steps of the values; samples on lines for each that bends by one
_LONG_LINE = 20  # samples: a command along longer lines is a ramp


def find_knots(times: FloatArray, values: FloatArray) -> BoolArray:
    """Find the samples (n,) at which a signal bends, and its ends."""
    is_knot = np.ones(values.size, dtype=np.bool_)
    slopes = np.diff(values) / np.maximum(np.diff(times), 1e-300)
    bends = np.abs(np.diff(slopes)) * np.diff(times)[1:]
    is_knot[1:-1] = bends > _LINE_SHARE * max(float(np.ptp(values)), 1e-300)
    return is_knot


def measure_drawn(values: FloatArray, is_knot: BoolArray) -> float:
    """Measure the share of samples that lie on lines, and move.

    Values in steps of a converter, or printed with few digits, lie on lines by chance. Then about
    as many bend by one step, and there is no share.
    """
    steps = np.diff(values)
    is_drawn = ~is_knot & np.concatenate([[True], steps != 0])
    count = int(np.count_nonzero(is_drawn))
    if not count:
        return 0.0
    quantum = float(np.min(np.abs(steps[steps != 0])))
    bends = np.abs(np.diff(steps))[is_knot[1:-1]]
    by_a_step = int(np.count_nonzero(bends < _ONE_STEP * quantum))
    return count / values.size if count > _PILED * by_a_step else 0.0


def find_resampling(signal: Signal) -> Iterator[Finding]:
    """Find values that were interpolated."""
    if not signal.is_told or signal.is_held or np.any(np.diff(signal.times) <= 0):
        return
    is_knot = find_knots(signal.times, signal.values)
    share = measure_drawn(signal.values, is_knot)
    lines = np.diff(np.flatnonzero(is_knot))
    lines = lines[lines > 1]
    if share <= _DRAWN_SHARE or float(np.median(lines)) > _LONG_LINE:
        return
    yield build_finding(
        "interpolated reading",
        "record",
        f"{100 * share:.0f} % of the values of {signal.name} lie exactly on straight lines between "
        "their neighbours: they were interpolated, and are no measurements.",
        (signal.name,),
        advice=f"Keep the measured rows of {signal.name}, and leave the others empty.",
    )
