"""Fewer points for a plot, without losing an extreme."""

import numpy as np

from sysid.core.types import FloatArray, IntArray


def decimate(
    times: FloatArray, values: FloatArray, max_points: int
) -> tuple[FloatArray, FloatArray]:
    """Samples of which no plot of that many points would miss one: least and greatest per bucket.

    Parameters
    ----------
    times, values : FloatArray, shape (N,)
        Missing values (``nan``) are passed over; where a whole bucket is missing, one stays, so
        that the line has its gap.
    max_points : int
        At least 2.

    Returns
    -------
    times, values : FloatArray, shape (at most max_points,)
        A subset of the samples, in their order; all of them if they are few enough.
    """
    if values.size <= max_points:
        return times, values
    kept = find_extremes(values, max_points)
    return times[kept], values[kept]


def find_extremes(values: FloatArray, max_points: int) -> IntArray:
    """Indices of the least and the greatest sample of each of ``max_points // 2`` buckets.

    Raises
    ------
    ValueError
        If `max_points` is below 2.
    """
    if max_points < 2:
        raise ValueError(f"max_points is {max_points}; need 2 or more")
    edges = np.linspace(0, values.size, max_points // 2 + 1).astype(np.int64)[:-1]
    known = np.isfinite(values)
    least = _find_first_extreme(np.where(known, values, np.inf), edges, np.minimum)
    greatest = _find_first_extreme(np.where(known, values, -np.inf), edges, np.maximum)
    return np.unique(np.concatenate([least, greatest]))


def _find_first_extreme(values: FloatArray, edges: IntArray, extreme: np.ufunc) -> IntArray:
    """Index of the first sample of each bucket that is the bucket's extreme."""
    lengths = np.diff(edges, append=values.size)
    found = values == np.repeat(extreme.reduceat(values, edges), lengths)
    hits = np.flatnonzero(found)
    return hits[np.searchsorted(hits, edges)].astype(np.int64)
