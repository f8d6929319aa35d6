"""Basin hopping: local searches that start near the champion, and detection of fitness jumps.

A hop along the covariance of the estimate stays in the champion's valley. A hop of one parameter
crosses the valley. It helps where the fitness is a comb of narrow valleys.

The fitness jumps near an estimate if, for example, dry friction switches a sample earlier. Then
neighbouring minima differ greatly in width. A wide one attracts most searches, and a better one
next to it attracts few. So it proves little how many searches returned to the best one.

A jump does not shrink under magnification. Consider increments of the loss between neighbouring
points on a straight line through the estimate. For a smooth loss they vary slowly. The increment
that differs most from its neighbours is divided into as many points again, and so on. For a smooth
loss almost nothing of the difference remains. For a jump all of it remains in one increment.

Two further tests decide whether to search far from the champion, and whether a far search is worth
continuing. They compare with the champion's own residuals. None of the tests depends on a scale.
"""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray
from sysid.kernels.borrowing import compile_borrowing
from sysid.search.levenberg_marquardt import factor_damped, write_spread_point
from sysid.search.operators import (
    USE_LOCAL_SEARCH,
    decode,
    draw_words,
    to_integer,
    to_normal,
    to_uniform,
)
from sysid.search.schedule import HOP_IN_ONE_PARAMETER
from sysid.search.slopes import build_normal_equations, choose_difference, evaluate_partial_fitness
from sysid.search.state import IslandArrays, IslandPlan, SearchRecord
from sysid.simulation.evaluator import Evaluator, evaluate_population, predict_partially
from sysid.simulation.scaling import from_unit

LINE_POINTS = 16  # points on a line: one SIMD vector
LINE_REACH = 5.0  # standard errors to both sides, in a random direction
_ZOOM_LEVELS = 4  # each examines a fifteenth of the last
MAX_LINE_SIMULATIONS = _ZOOM_LEVELS * LINE_POINTS
_JUMP_REMAINDER = 0.25  # of the difference; a smooth loss leaves less than a tenth
_HIGH_LOSS = 4.0  # times the loss at the point: jumps to much worse losses do not matter


@jit_compile
def find_odd_increment(losses: FloatArray) -> tuple[int, float]:
    """Find the increment that differs most from the mean of its neighbours, and the difference.

    The difference is 0 where the losses follow a parabola.
    """
    index, largest = 1, 0.0
    for i in range(1, losses.size - 2):
        before, after = losses[i] - losses[i - 1], losses[i + 2] - losses[i + 1]
        difference = abs(losses[i + 1] - losses[i] - 0.5 * (before + after))
        if difference > largest:
            index, largest = i, difference
    return index, largest


@compile_borrowing
def _evaluate_line(
    evaluator: Evaluator,
    factor: FloatArray,
    point: FloatArray,
    direction: FloatArray,
    first: float,
    last: float,
    largest_loss: float,
) -> FloatArray:
    """Evaluate the squared fitness, limited to `largest_loss`, at equal distances on a line."""
    points, deviation = np.empty((LINE_POINTS, point.size)), np.empty(point.size)
    for p in range(LINE_POINTS):
        for d in range(point.size):
            deviation[d] = (first + (last - first) * p / (LINE_POINTS - 1)) * direction[d]
        write_spread_point(factor, point, deviation, points[p])
    return np.minimum(
        evaluate_population(evaluator, from_unit(evaluator, points)) ** 2, largest_loss
    )


@compile_borrowing
def has_discontinuity(
    evaluator: Evaluator,
    factor: FloatArray,
    point: FloatArray,
    direction: FloatArray,
    base: float,
    search: SearchRecord,
) -> bool:
    """Return whether the loss jumps on a line through a point (D,).

    It takes at most `MAX_LINE_SIMULATIONS` simulations.

    Parameters
    ----------
    factor : FloatArray, shape (D, D)
        Factor of the normal matrix (`sysid.search.levenberg_marquardt.factor_damped`).
    direction : FloatArray, shape (D,)
        Standard normal numbers times the fitness `base` at the point: a standard error.
    search : SearchRecord
        Search record of the island, which counts the simulations.
    """
    first, width, before, upper_loss = -LINE_REACH, 2.0 * LINE_REACH, 0.0, 0.0
    variance, largest_loss = base**2 / evaluator.n_scored, _HIGH_LOSS * base**2
    for level in range(_ZOOM_LEVELS):
        search.evaluations += LINE_POINTS
        losses = _evaluate_line(
            evaluator, factor, point, direction, first, first + width, largest_loss
        )
        index, difference = find_odd_increment(losses)
        if difference <= variance or (level > 0 and difference <= _JUMP_REMAINDER * before):
            return False
        before, width = difference, width / (LINE_POINTS - 1)
        first += index * width
        upper_loss = max(losses[index], losses[index + 1])
    return bool(upper_loss < largest_loss)


MIN_HOP, MAX_HOP = 0.3, 50.0  # standard errors
SINGLE_HOP_FACTOR = 10.0  # one parameter moves so much farther, in its conditional standard errors
PROBED_HOPS = 4  # hops that also test for jumps of the fitness, until there is one
LINES_PER_HOP = 2  # lines that each of them tests


@compile_borrowing
def hop_from_champion(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> None:
    """Move the point away from the champion, along the covariance or in one parameter."""
    point, search = island.point, island.search
    search.evaluations += point.size + 1
    difference = choose_difference(plan, search)
    matrix, gradient, base = build_normal_equations(evaluator, plan, point, 1.0, difference)
    word = draw_words(plan.seed, USE_LOCAL_SEARCH, plan.island, search.generation, 0)
    size = base * MIN_HOP * (MAX_HOP / MIN_HOP) ** to_uniform(word[0])
    factor = factor_damped(matrix, gradient, point, 0.0)
    if search.hop_is_evidence:
        _probe_discontinuities(evaluator, plan, factor, base, island)
    if search.hop == HOP_IN_ONE_PARAMETER:
        _move_single_parameter(plan, search, matrix, SINGLE_HOP_FACTOR * size, point)
    else:
        write_spread_point(factor, point, _draw_deviation(plan, search, 0, size, point.size), point)


@jit_compile
def _move_single_parameter(
    plan: IslandPlan, search: SearchRecord, matrix: FloatArray, size: float, point: FloatArray
) -> None:
    """Move one parameter by some of its conditional standard errors, across the valley.

    A parameter without effect on the output stays.
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
    """Draw normal numbers (n,) with the standard deviation `size`."""
    drawn = np.empty(n)
    for d in range(n):
        draw = 1 + line * n + d
        word = draw_words(plan.seed, USE_LOCAL_SEARCH, plan.island, search.generation, draw)
        drawn[d] = size * to_normal(word)
    return drawn


@compile_borrowing
def _probe_discontinuities(
    evaluator: Evaluator, plan: IslandPlan, factor: FloatArray, base: float, island: IslandArrays
) -> None:
    """Record whether the fitness jumps on lines through the point; not at the end of a budget."""
    point, search = island.point, island.search
    for line in range(1, LINES_PER_HOP + 1):
        if (
            search.evaluations + MAX_LINE_SIMULATIONS + point.size + 1 > plan.most_evaluations
            or not np.isfinite(base)
        ):
            return
        if search.champion_discontinuities == 0 and search.hop_count < PROBED_HOPS:
            direction = _draw_deviation(plan, search, line, base, point.size)
            jumps = has_discontinuity(evaluator, factor, point, direction, base, search)
            search.champion_discontinuities += jumps
            # A warm start needs fewer agreeing restarts, a number chosen for smooth fitness.
            search.fitness_discontinuities += jumps and not search.is_warm_start


COLOUR_THRESHOLD = 0.5  # correlation of neighbouring residuals: noise has 0, a wrong response 1
NOISE_LAGS = 10  # of the autocorrelation
NOISE_LIMIT = 29.6  # of Box and Pierce's statistic: noise exceeds it with a probability of 0.1 %


@jit_compile
def _predict_champion(
    evaluator: Evaluator, plan: IslandPlan, island: IslandArrays, horizon: float
) -> FloatArray:
    """Simulate the champion up to a part of the record: predictions (M, 1 or more)."""
    island.search.evaluations += 1
    champion = from_unit(evaluator, decode(island.chromosomes[:1], plan.bits))
    return predict_partially(evaluator, champion, horizon)


@jit_compile
def _compute_champion_errors(
    evaluator: Evaluator, plan: IslandPlan, island: IslandArrays
) -> FloatArray:
    """Compute the champion's weighted residuals (M,), scored ones only; takes one simulation."""
    predicted = _predict_champion(evaluator, plan, island, 1.0)[:, 0]
    errors = evaluator.weight * (predicted - evaluator.measured)
    return np.asarray(errors[evaluator.weight != 0.0])


@jit_compile
def _sum_lagged(errors: FloatArray, lag: int) -> float:
    """Sum the products of residuals (M,) and those `lag` samples before them."""
    total = 0.0
    for m in range(lag, errors.size):
        total += errors[m] * errors[m - lag]
    return total


@jit_compile
def is_champion_coloured(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> bool:
    """Return whether the champion's residuals are autocorrelated; takes one simulation.

    If so, the residuals are more than noise. Neighbours are consecutive measured values.
    """
    errors = _compute_champion_errors(evaluator, plan, island)
    return _sum_lagged(errors, 1) > COLOUR_THRESHOLD * _sum_lagged(errors, 0)


@jit_compile
def is_champion_explained(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> bool:
    """Return whether the champion's residuals look like noise; takes one simulation.

    It is the portmanteau test of Box and Pierce. A false minimum leaves a part of the response in
    its residuals. False at the end of the budget, and for residuals that are too few.
    """
    if island.search.evaluations >= plan.most_evaluations:
        return False
    errors = _compute_champion_errors(evaluator, plan, island)
    squares, statistic = _sum_lagged(errors, 0), 0.0
    if errors.size < 2 * NOISE_LAGS or not 0.0 < squares < np.inf:
        return False
    for lag in range(1, NOISE_LAGS + 1):
        statistic += errors.size * (_sum_lagged(errors, lag) / squares) ** 2
    return bool(statistic < NOISE_LIMIT)


@jit_compile
def is_behind_champion(
    evaluator: Evaluator, plan: IslandPlan, island: IslandArrays, horizon: float, reached: float
) -> bool:
    """Return whether the champion fits a part of the record better; takes one simulation.

    `reached` is the fitness of the search on that part. False at the end of the budget.
    """
    if island.search.evaluations >= plan.most_evaluations:
        return False
    predicted = _predict_champion(evaluator, plan, island, horizon)
    return bool(evaluate_partial_fitness(evaluator, plan, predicted, horizon)[0] < reached)
