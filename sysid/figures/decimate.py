"""Reduce the points of a plot without losing an extreme."""

import numpy as np

from sysid.core.types import FloatArray, IntArray


def decimate(
    times: FloatArray, values: FloatArray, max_points: int
) -> tuple[FloatArray, FloatArray]:
    """Keep the smallest and the largest sample of each bucket, so that no extreme is lost.

    Parameters
    ----------
    times, values : FloatArray, shape (N,)
        Missing values (``nan``) are skipped. If a whole bucket is missing, one of them stays, so
        that the line shows a gap.
    max_points : int
        At least 2.

    Returns
    -------
    times, values : FloatArray, shape (at most max_points,)
        A subset of the samples in their order; all samples if they are few enough.
    """
    if values.size <= max_points:
        return times, values
    extremes = find_extremes(values, max_points)
    return times[extremes], values[extremes]


def find_extremes(values: FloatArray, max_points: int) -> IntArray:
    """Return the indices of the extremes of each of ``max_points // 2`` buckets.

    Raises
    ------
    ValueError
        If `max_points` is below 2.
    """
    if max_points < 2:
        raise ValueError(f"max_points is {max_points}; need 2 or more")
    edges = np.linspace(0, values.size, max_points // 2 + 1).astype(np.int64)[:-1]
    is_finite = np.isfinite(values)
    least = _find_first_extreme(np.where(is_finite, values, np.inf), edges, np.minimum)
    greatest = _find_first_extreme(np.where(is_finite, values, -np.inf), edges, np.maximum)
    return np.unique(np.concatenate([least, greatest]))


def _find_first_extreme(values: FloatArray, edges: IntArray, extreme: np.ufunc) -> IntArray:
    """Return the index of the first extreme sample of each bucket."""
    lengths = np.diff(edges, append=values.size)
    is_extreme = values == np.repeat(extreme.reduceat(values, edges), lengths)
    hits = np.flatnonzero(is_extreme)
    return hits[np.searchsorted(hits, edges)].astype(np.int64)
