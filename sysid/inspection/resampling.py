"""Resampling: values on straight lines between fewer ones, which alone were measured."""

from collections.abc import Iterator

import numpy as np

from sysid.core.findings import Finding
from sysid.core.types import BoolArray, FloatArray
from sysid.inspection.quantisation import find_quantum
from sysid.inspection.signal import Signal, build_finding

_LINE_SHARE = 1e-6  # of the range: a bend
_DRAWN_SHARE = 0.1  # of the samples that lie on lines; of measured ones none does
_LONG_LINE = 20  # samples: a command along longer lines is a ramp


def find_knots(times: FloatArray, values: FloatArray) -> BoolArray:
    """Find the samples (n,) at which a signal bends, and its ends."""
    is_knot = np.ones(values.size, dtype=np.bool_)
    slopes = np.diff(values) / np.maximum(np.diff(times), 1e-300)
    bends = np.abs(np.diff(slopes)) * np.diff(times)[1:]
    is_knot[1:-1] = bends > _LINE_SHARE * max(float(np.ptp(values)), 1e-300)
    return is_knot


def measure_drawn(values: FloatArray, is_knot: BoolArray) -> float:
    """Measure the share of samples that lie on lines, and move."""
    is_moving = np.concatenate([[True], np.diff(values) != 0])
    return float(np.mean(~is_knot & is_moving))


def find_resampling(signal: Signal) -> Iterator[Finding]:
    """Find values that were interpolated."""
    if not signal.is_told or signal.is_held or np.any(np.diff(signal.times) <= 0):
        return
    if find_quantum(signal) is not None:
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
