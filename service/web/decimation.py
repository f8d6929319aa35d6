"""Thinning of lines to what a screen can show, without losing what the eye looks for."""

import numpy as np
from numpy.typing import NDArray

from service.signals.decimate import extremes
from service.web.evidence import Floats

MAX_POINTS = 1000


def thinned(values: Floats, max_points: int = MAX_POINTS) -> NDArray[np.intp]:
    """Indices of at most `max_points` samples: the ends, and each bin's least and greatest.

    A spike of one sample therefore stays visible at any zoom. Several arrays may share them.
    """
    if values.size <= max_points:
        return np.arange(values.size)
    inner = extremes(values, max_points - 2)
    return np.unique(np.concatenate([[0, values.size - 1], inner])).astype(np.intp)


def window(times: Floats, start: float | None, stop: float | None) -> slice:
    """Samples between two times (s), with one more at each side so that lines reach the edge."""
    first = 0 if start is None else int(np.searchsorted(times, start, "left")) - 1
    last = times.size if stop is None else int(np.searchsorted(times, stop, "right")) + 1
    return slice(max(first, 0), min(last, times.size))


def strided(count: int, max_points: int = MAX_POINTS) -> NDArray[np.intp]:
    """Indices of at most `max_points` of `count` steps, the first and the last among them."""
    if count <= max_points:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, max_points).round().astype(np.intp))
