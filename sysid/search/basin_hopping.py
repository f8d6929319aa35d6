"""Hops: developments that begin beside the champion, a little way off or one parameter far off.

Along the covariance of the estimate a hop stays in the champion's valley. One parameter alone
leaves it across: that leads out where the fitness is a comb of narrow valleys side by side.

Jumps of the fitness beside an estimate, as where dry friction switches a sample earlier.

Then minima lie side by side that differ in width by far: a wide one draws most searches while a
better one next to it draws few, and counting how often the best was found again proves little.

A jump is what does not shrink. On a straight line through the estimate, the increments of the loss
between neighbouring places vary slowly where it is smooth. The one that differs most from its
neighbours is looked at again, with as many places inside of it, and so on: of a smooth loss next
to nothing of that difference is left in any of these, of a jump all of it in one. No scale enters.

Whether more is to be found far from the champion, and whether a start far away leads nowhere.

Both compare with nothing but the champion's own errors, so no scale enters.
"""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray
from sysid.search.levenberg_marquardt import factor_damped, write_spread_place
from sysid.search.operators import (
    USE_LOCAL_SEARCH,
    decode,
    draw_words,
    to_integer,
    to_normal,
    to_uniform,
)
from sysid.search.slopes import build_normal_equations, choose_difference, evaluate_partial_fitness
from sysid.search.state import IslandArrays, IslandPlan, SearchRecord
from sysid.simulation.evaluator import Evaluator, evaluate_population, predict_partially
from sysid.simulation.scaling import from_unit

LINE_PLACES = 16  # on a line: one block of lanes
LINE_REACH = 5.0  # standard errors to both sides, in a random direction
_ZOOM_LEVELS = 4  # each looks at a fifteenth of the last
MOST_LINE_SIMULATIONS = _ZOOM_LEVELS * LINE_PLACES
_JUMP_REMAINDER = 0.25  # of the difference; a smooth loss leaves less than a tenth
_HIGH_LOSS = (
    4.0  # times the loss at the point: edges of what is far worse, or diverges, do not matter
)


@jit_compile
def find_odd_increment(losses: FloatArray) -> tuple[int, float]:
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


@jit_compile
def _evaluate_line(
    evaluator: Evaluator,
    factor: FloatArray,
    point: FloatArray,
    direction: FloatArray,
    first: float,
    last: float,
    most: float,
) -> FloatArray:
    """Squared fitness, `most` at most, at equal distances on a line through the point."""
    places, deviation = np.empty((LINE_PLACES, point.size)), np.empty(point.size)
    for p in range(LINE_PLACES):
        for d in range(point.size):
            deviation[d] = (first + (last - first) * p / (LINE_PLACES - 1)) * direction[d]
        write_spread_place(factor, point, deviation, places[p])
    return np.minimum(evaluate_population(evaluator, from_unit(evaluator, places)) ** 2, most)


@jit_compile
def has_discontinuity(
    evaluator: Evaluator,
    factor: FloatArray,
    point: FloatArray,
    direction: FloatArray,
    base: float,
    search: SearchRecord,
) -> bool:
    """Whether the loss jumps on a line through a point (D,), in at most `MOST_LINE_SIMULATIONS` simulations.

    Parameters
    ----------
    factor : FloatArray, shape (D, D)
        That of the sums of products of slopes (`sysid.search.levenberg_marquardt.factor_damped`).
    direction : FloatArray, shape (D,)
        Standard normal numbers times the fitness `base` at the point: a standard error.
    search : SearchRecord
        The island's: simulations are counted.
    """
    first, width, before, above = -LINE_REACH, 2.0 * LINE_REACH, 0.0, 0.0
    variance, most = base**2 / evaluator.n_scored, _HIGH_LOSS * base**2
    for level in range(_ZOOM_LEVELS):
        search.evaluations += LINE_PLACES
        losses = _evaluate_line(evaluator, factor, point, direction, first, first + width, most)
        place, unlike = find_odd_increment(losses)
        if unlike <= variance or (level > 0 and unlike <= _JUMP_REMAINDER * before):
            return False
        before, width = unlike, width / (LINE_PLACES - 1)
        first += place * width
        above = max(losses[place], losses[place + 1])
    return bool(above < most)


SHORTEST_HOP, LONGEST_HOP = 0.3, 50.0  # standard errors
COUNTED_HOP, UNCOUNTED_HOP, SINGLE_PARAMETER_HOP = (
    1,
    2,
    4,
)  # hops: evidence for the champion or not; of one parameter
SINGLE_HOP_FACTOR = (
    10.0  # times as far, in standard errors with the others held, one parameter moves
)
PROBED_HOPS = 4  # hops that also look for jumps of the fitness, as long as there is none
LINES_PER_HOP = 2  # on which each does


@jit_compile
def hop_from_champion(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> None:
    """Move the point away: as the estimate's covariance spreads it, or one parameter alone."""
    point, search = island.point, island.search
    search.evaluations += point.size + 1
    difference = choose_difference(plan, search)
    matrix, gradient, base = build_normal_equations(evaluator, plan, point, 1.0, difference)
    word = draw_words(plan.seed, USE_LOCAL_SEARCH, plan.island, search.generation, 0)
    size = base * SHORTEST_HOP * (LONGEST_HOP / SHORTEST_HOP) ** to_uniform(word[0])
    factor = factor_damped(matrix, gradient, point, 0.0)
    if search.hop_kind & COUNTED_HOP:
        _probe_discontinuities(evaluator, plan, factor, base, island)
    if search.hop_kind & SINGLE_PARAMETER_HOP:
        _move_single_parameter(plan, search, matrix, SINGLE_HOP_FACTOR * size, point)
    else:
        write_spread_place(factor, point, _draw_deviation(plan, search, 0, size, point.size), point)


@jit_compile
def _move_single_parameter(
    plan: IslandPlan, search: SearchRecord, matrix: FloatArray, size: float, point: FloatArray
) -> None:
    """Move one parameter by so many of its standard errors with the others held: off the valley.

    One to which the output is insensitive stays.
    """
    word = draw_words(plan.seed, USE_LOCAL_SEARCH, plan.island, search.generation, 1)
    d = to_integer(word[2], point.size)
    if 0.0 < matrix[d, d] < np.inf:
        moved = point[d] + size * to_normal(word) / np.sqrt(matrix[d, d])
        point[d] = min(max(moved, 0.0), 1.0)


@jit_compile
def _draw_deviation(
    plan: IslandPlan, search: SearchRecord, line: int, size: float, n: int
) -> FloatArray:
    """Normal numbers (n,) of that standard deviation."""
    drawn = np.empty(n)
    for d in range(n):
        draw = 1 + line * n + d
        word = draw_words(plan.seed, USE_LOCAL_SEARCH, plan.island, search.generation, draw)
        drawn[d] = size * to_normal(word)
    return drawn


@jit_compile
def _probe_discontinuities(
    evaluator: Evaluator, plan: IslandPlan, factor: FloatArray, base: float, island: IslandArrays
) -> None:
    """Note whether the fitness jumps on lines through the point; not where a budget ends."""
    point, search = island.point, island.search
    for line in range(1, LINES_PER_HOP + 1):
        if (
            search.evaluations + MOST_LINE_SIMULATIONS + point.size + 1 > plan.most_evaluations
            or not np.isfinite(base)
        ):
            return
        if search.champion_discontinuities == 0 and search.hop_count < PROBED_HOPS:
            direction = _draw_deviation(plan, search, line, base, point.size)
            jumps = has_discontinuity(evaluator, factor, point, direction, base, search)
            search.champion_discontinuities += jumps
            # A warm start settles by fewer searches, chosen with those of a smooth fitness.
            search.fitness_discontinuities += jumps and search.is_warm_start == 0


COLOUR_THRESHOLD = (
    0.5  # correlation of neighbouring errors: noise has none, a wrong response nearly 1
)


@jit_compile
def _predict_champion(
    evaluator: Evaluator, plan: IslandPlan, island: IslandArrays, horizon: float
) -> FloatArray:
    """Predictions (M, 1 or more) of the champion up to that part of the record."""
    island.search.evaluations += 1
    champion = from_unit(evaluator, decode(island.chromosomes[:1], plan.bits))
    return predict_partially(evaluator, champion, horizon)


@jit_compile
def is_champion_coloured(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> bool:
    """Whether the champion's errors go together with their neighbours: a simulation.

    Then far more than noise is left to explain. Neighbours are so in the list of measured values.
    """
    predicted = _predict_champion(evaluator, plan, island, 1.0)
    products, squares, last = 0.0, 0.0, 0.0
    for m in range(predicted.shape[0]):
        if evaluator.weight[m] != 0.0:
            error = evaluator.weight[m] * (predicted[m, 0] - evaluator.measured[m])
            products += error * last
            squares += error * error
            last = error
    return bool(products > COLOUR_THRESHOLD * squares)


@jit_compile
def is_behind_champion(
    evaluator: Evaluator, plan: IslandPlan, island: IslandArrays, horizon: float, reached: float
) -> bool:
    """Whether the champion fits a part better than what was fitted to it: a simulation.

    Not where the budget ends.
    """
    if island.search.evaluations >= plan.most_evaluations:
        return False
    predicted = _predict_champion(evaluator, plan, island, horizon)
    return bool(evaluate_partial_fitness(evaluator, plan, predicted, horizon)[0] < reached)
