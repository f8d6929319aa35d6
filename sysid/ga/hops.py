"""Hops: developments that begin beside the champion, a little way off or one parameter far off.

Along the covariance of the estimate a hop stays in the champion's valley. One parameter alone
leaves it across: that leads out where the fitness is a comb of narrow valleys side by side.
"""

import numpy as np

from sysid.ga.cliffs import MOST, has_cliff
from sysid.ga.gauss_newton import factored, normal_equations, slope_distance, spread
from sysid.ga.random import DEVELOPMENT, below, draws, normal, unit
from sysid.ga.state import (
    CLIFFS,
    EVALUATIONS,
    GENERATION,
    HOP,
    HOPS,
    JUMPS,
    POINT,
    WARMED,
    Plan,
)  # fmt: skip
from sysid.kernels.caching import compiled
from sysid.kernels.evaluator import Evaluator
from sysid.types import FloatArray, IntArray

SHORTEST_HOP, LONGEST_HOP = 0.3, 50.0  # standard errors
COUNTED, UNCOUNTED, SINGLE = 1, 2, 4  # hops: evidence for the champion or not; of one parameter
FARTHER = 10.0  # times as far, in standard errors with the others held, one parameter moves
LOOKS = 4  # hops that also look for jumps of the fitness, as long as there is none
LINES = 2  # on which each does


@compiled
def hop(evaluator: Evaluator, plan: Plan, counters: IntArray, memory: FloatArray) -> None:
    """Move the point away: as the estimate's covariance spreads it, or one parameter alone."""
    point = memory[POINT:]
    counters[EVALUATIONS] += point.size + 1
    difference = slope_distance(plan, counters, memory)
    matrix, gradient, base = normal_equations(evaluator, plan, point, 1.0, difference)
    word = draws(plan.seed, DEVELOPMENT, plan.island, counters[GENERATION], 0)
    size = base * SHORTEST_HOP * (LONGEST_HOP / SHORTEST_HOP) ** unit(word[0])
    factor = factored(matrix, gradient, point, 0.0)
    if counters[HOP] & COUNTED:
        _look(evaluator, plan, factor, base, counters, memory)
    if counters[HOP] & SINGLE:
        _move_one(plan, counters, matrix, FARTHER * size, point)
    else:
        spread(factor, point, _deviation(plan, counters, 0, size, point.size), point)


@compiled
def _move_one(
    plan: Plan, counters: IntArray, matrix: FloatArray, size: float, point: FloatArray
) -> None:
    """Move one parameter by so many of its standard errors with the others held: off the valley.

    One to which the output is insensitive stays.
    """
    word = draws(plan.seed, DEVELOPMENT, plan.island, counters[GENERATION], 1)
    d = below(word[2], point.size)
    if 0.0 < matrix[d, d] < np.inf:
        moved = point[d] + size * normal(word) / np.sqrt(matrix[d, d])
        point[d] = min(max(moved, 0.0), 1.0)


@compiled
def _deviation(plan: Plan, counters: IntArray, line: int, size: float, n: int) -> FloatArray:
    """Normal numbers (n,) of that standard deviation."""
    drawn = np.empty(n)
    for d in range(n):
        draw = 1 + line * n + d
        word = draws(plan.seed, DEVELOPMENT, plan.island, counters[GENERATION], draw)
        drawn[d] = size * normal(word)
    return drawn


@compiled
def _look(
    evaluator: Evaluator, plan: Plan, factor: FloatArray, base: float, counters: IntArray,
    memory: FloatArray,
) -> None:  # fmt: skip
    """Note whether the fitness jumps on lines through the point; not where a budget ends."""
    point = memory[POINT:]
    for line in range(1, LINES + 1):
        if counters[EVALUATIONS] + MOST + point.size + 1 > plan.evaluations or not np.isfinite(
            base
        ):
            return
        if counters[CLIFFS] == 0 and counters[HOPS] < LOOKS:
            direction = _deviation(plan, counters, line, base, point.size)
            counters[CLIFFS] += has_cliff(evaluator, factor, point, direction, base, counters)
            # A warm start settles by fewer searches, chosen with those of a smooth fitness.
            counters[JUMPS] += counters[CLIFFS] if counters[WARMED] == 0 else 0
