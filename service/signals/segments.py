"""Repeats of a measurement, laid end to end on one time axis."""

from collections.abc import Mapping, Sequence
from math import floor, log10

import numpy as np

from sysid.core.types import FloatArray, IntArray
from sysid.data.records import Segment

Labels = Mapping[str, float | str]


def lay_out(
    times: FloatArray, starts: IntArray, labels: Sequence[Labels]
) -> tuple[FloatArray, tuple[Segment, ...]]:
    """Times on one axis for segments whose own times may all begin anew.

    Segment i begins at i steps, the step being the smallest of 1, 2, 5, 10, … · 10ᵏ s that is
    longer than every segment: so a segment's place is easily read and its times stay exact.

    Parameters
    ----------
    times : FloatArray, shape (N,)
        Own times in s, growing within each segment.
    starts : IntArray, shape (n_segments,)
        First sample of each.
    labels : sequence of mappings, n_segments long
    """
    lasts = np.append(starts[1:], times.size) - 1
    step = _step_above(float(np.max(times[lasts] - times[starts])))
    axis = np.empty_like(times)
    segments = []
    for i, (first, last) in enumerate(zip(starts, lasts, strict=True)):
        origin, start = float(times[first]), i * step
        # To the nanosecond: what a file's clock holds, so that a stored time is the same again.
        axis[first : last + 1] = np.round(start + (times[first : last + 1] - origin), 9)
        segments.append(Segment(start, float(axis[last]), origin, dict(labels[i])))
    return axis, tuple(segments)


def _step_above(longest: float) -> float:
    if longest <= 0:
        return 1.0
    decade = 10.0 ** floor(log10(longest))
    return next(step for m in (1, 2, 5, 10, 20) if (step := m * decade) > longest)
