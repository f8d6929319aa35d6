"""Archive of the minima in which the local searches from random points ended.

A minimum is kept with its fitness, its point in [0, 1] and how many searches ended there. Searches
that begin near the champion return to it, and show nothing. A full archive forgets its worst
minimum for a better one.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray

SAME_POINT = 1e-3  # of the range: nearer ends are one minimum
_SIZE = 16
_FITNESS, _COUNT, _POINT = range(3)  # columns; D coordinates follow


@dataclass(frozen=True, slots=True, eq=False)
class ArchivedMinimum:
    """A minimum: its point (D,) in [0, 1], and how many searches from random points ended there."""

    point: FloatArray
    count: int


def make_archive(n: int) -> FloatArray:
    """Make an empty archive for n parameters, shape (16, 2 + n)."""
    archive = np.zeros((_SIZE, _POINT + n))
    archive[:, _FITNESS] = np.inf
    return archive


def read_archive(archive: FloatArray) -> list[ArchivedMinimum]:
    """Read the minima of an archive."""
    return [
        ArchivedMinimum(row[_POINT:], int(row[_COUNT]))
        for row in archive[np.isfinite(archive[:, _FITNESS])]
    ]


def convert_archive(
    archive: FloatArray, convert: Callable[[FloatArray], FloatArray], n: int
) -> FloatArray:
    """Convert the points of an archive to n other coordinates; empty rows stay empty."""
    converted = make_archive(n)
    converted[:, :_POINT] = archive[:, :_POINT]
    for row in np.flatnonzero(np.isfinite(archive[:, _FITNESS])):
        converted[row, _POINT:] = convert(archive[row, _POINT:])
    return converted


@jit_compile
def _find_row(archive: FloatArray, point: FloatArray) -> tuple[int, bool]:
    """Find the row of a minimum, or the worst one; say whether the minimum is known."""
    for m in range(archive.shape[0]):
        distance = 0.0
        for d in range(point.size):
            distance = max(distance, abs(archive[m, _POINT + d] - point[d]))
        if distance < SAME_POINT and np.isfinite(archive[m, _FITNESS]):
            return m, True
    return int(np.argmax(archive[:, _FITNESS])), False


@jit_compile
def archive_end(archive: FloatArray, point: FloatArray, fitness: float) -> None:
    """Archive the end (D,) of a local search from a random point, in place."""
    row, is_known = _find_row(archive, point)
    is_better = fitness < archive[row, _FITNESS]
    if not is_known:
        if not is_better:
            return
        archive[row, _COUNT] = 0.0
    archive[row, _COUNT] += 1.0
    if is_better:
        archive[row, _FITNESS] = fitness
        for d in range(point.size):
            archive[row, _POINT + d] = point[d]
