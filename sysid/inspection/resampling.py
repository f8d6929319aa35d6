"""Resampling: values on straight lines between fewer ones, which alone were measured."""

from collections.abc import Iterator

import numpy as np

from sysid.core.findings import Finding
from sysid.core.types import BoolArray, FloatArray
from sysid.inspection.signal import Signal, build_finding

_LINE_SHARE = 1e-6  # of the range: a bend
_DRAWN_SHARE = 0.1  # of the samples that lie on lines; of measured ones none does
_ONE_STEP, _PILED = 1.5, 3.0  # steps of the values; samples on lines for each that bends by one
_EVEN_SHARE = 0.8  # of the lines, as long as their median give or take a sample: an even clock
_MOST_KNOTS = (
    4  # samples: a bend between two samples of the grid shows at two, and lines have two ends
)
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
    if share <= _DRAWN_SHARE or not _are_even(is_knot):
        return
    yield build_finding(
        "interpolated reading",
        "record",
        f"{100 * share:.0f} % of the values of {signal.name} lie exactly on straight lines between "
        "their neighbours: they were interpolated, and are no measurements.",
        (signal.name,),
        advice=f"Keep the measured rows of {signal.name}, and leave the others empty.",
    )


def _are_even(is_knot: BoolArray) -> bool:
    """Whether lines come evenly, as between the samples of a slower clock.

    A signal that was simulated is nearly straight where it is slow, and bent elsewhere. A command
    along ramps has long lines.
    """
    edges = np.flatnonzero(np.diff(is_knot)) + 1
    lengths = np.diff(np.concatenate([[0], edges, [is_knot.size]]))
    bent, straight = lengths[::2], lengths[1::2]  # the first sample is a knot
    middle = float(np.median(straight))
    return bool(
        middle <= _LONG_LINE
        and np.mean(np.abs(straight - middle) <= 1) >= _EVEN_SHARE
        and np.mean(bent <= _MOST_KNOTS) >= _EVEN_SHARE
    )
