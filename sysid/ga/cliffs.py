"""Jumps of the fitness beside an estimate, as where dry friction switches a sample earlier.

Then minima lie side by side that differ in width by far: a wide one draws most searches while a
better one next to it draws few, and counting how often the best was found again proves little.

A jump is what does not shrink. On a straight line through the estimate, the increments of the loss
between neighbouring places vary slowly where it is smooth. The one that differs most from its
neighbours is looked at again, with as many places inside of it, and so on: of a smooth loss next
to nothing of that difference is left in any of these, of a jump all of it in one. No scale enters.
"""

import numpy as np

from sysid.ga.chromosome import located
from sysid.ga.gauss_newton import spread
from sysid.ga.state import EVALUATIONS
from sysid.kernels.caching import compiled
from sysid.kernels.evaluation import population_fitness
from sysid.kernels.evaluator import Evaluator
from sysid.types import FloatArray, IntArray

PLACES = 16  # on a line: one block of lanes
REACH = 5.0  # standard errors to both sides, in a random direction
_LEVELS = 4  # each looks at a fifteenth of the last
MOST = _LEVELS * PLACES
_LEFT = 0.25  # of the difference; a smooth loss leaves less than a tenth
_HIGH = 4.0  # times the loss at the point: edges of what is far worse, or diverges, do not matter


@compiled
def most_unlike(losses: FloatArray) -> tuple[int, float]:
    """The increment that differs most from the mean of its two neighbours, and by how much.

    By nothing where the losses vary as a parabola.
    """
    place, most = 1, 0.0
    for i in range(1, losses.size - 2):
        before, after = losses[i] - losses[i - 1], losses[i + 2] - losses[i + 1]
        unlike = abs(losses[i + 1] - losses[i] - 0.5 * (before + after))
        if unlike > most:
            place, most = i, unlike
    return place, most


@compiled
def _losses(
    evaluator: Evaluator, factor: FloatArray, point: FloatArray, direction: FloatArray,
    first: float, last: float, most: float,
) -> FloatArray:  # fmt: skip
    """Squared fitness, `most` at most, at equal distances on a line through the point."""
    places, deviation = np.empty((PLACES, point.size)), np.empty(point.size)
    for p in range(PLACES):
        for d in range(point.size):
            deviation[d] = (first + (last - first) * p / (PLACES - 1)) * direction[d]
        spread(factor, point, deviation, places[p])
    return np.minimum(population_fitness(evaluator, located(evaluator, places)) ** 2, most)


@compiled
def has_cliff(
    evaluator: Evaluator, factor: FloatArray, point: FloatArray, direction: FloatArray,
    base: float, counters: IntArray,
) -> bool:  # fmt: skip
    """Whether the loss jumps on a line through a point (D,), in at most `MOST` simulations.

    Parameters
    ----------
    factor : FloatArray, shape (D, D)
        That of the sums of products of slopes (`sysid.ga.gauss_newton.factored`).
    direction : FloatArray, shape (D,)
        Standard normal numbers times the fitness `base` at the point: a standard error.
    counters : IntArray
        The island's: simulations are counted.
    """
    first, width, before, above = -REACH, 2.0 * REACH, 0.0, 0.0
    variance, most = base**2 / evaluator.n_weight, _HIGH * base**2
    for level in range(_LEVELS):
        counters[EVALUATIONS] += PLACES
        losses = _losses(evaluator, factor, point, direction, first, first + width, most)
        place, unlike = most_unlike(losses)
        if unlike <= variance or (level > 0 and unlike <= _LEFT * before):
            return False
        before, width = unlike, width / (PLACES - 1)
        first += place * width
        above = max(losses[place], losses[place + 1])
    return bool(above < most)
