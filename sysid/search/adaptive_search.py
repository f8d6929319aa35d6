"""Adaptive sequence search, the local search of the improved algorithm.

Like the paper's sequence search (its "development" operator) it proposes neighbours of one
individual, keeps the best and continues while it gains. Here the direction and the size of the
steps come from the sensitivities of the output. Each generation is one Levenberg–Marquardt step
with several dampings tried at once.

A time lag makes the fitness over a whole record a comb of local minima. The longer the record, the
denser the comb. So some searches start from the best of new random individuals, on the first part
of the record, where the comb is wide. They extend that part step by step.
"""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray, WordArray
from sysid.kernels.borrowing import compile_borrowing
from sysid.search.archive import archive_end
from sysid.search.basin_hopping import (
    hop_from_champion,
    is_behind_champion,
    is_champion_coloured,
    is_champion_explained,
)
from sysid.search.levenberg_marquardt import factor_damped, write_damped_step, write_spread_point
from sysid.search.operators import (
    USE_LOCAL_SEARCH,
    decode,
    draw_words,
    encode,
    sort_population,
    to_normal,
    to_uniform,
)
from sysid.search.schedule import (
    AT_CHAMPION,
    AT_INDIVIDUAL,
    AT_RANDOM_POINT,
    EARLY_SEARCHES,
    NO_HOP,
    asks_residuals,
    begin_growth,
    choose_local_search,
)
from sysid.search.slopes import build_normal_equations, choose_difference, evaluate_partial_fitness
from sysid.search.state import SAME_OPTIMUM, IslandArrays, IslandPlan, SearchRecord
from sysid.simulation.evaluator import Evaluator, evaluate_population, predict_partially
from sysid.simulation.scaling import from_unit

N_TRIALS = 3
DAMPING_FACTOR = 10.0  # between the dampings of two trials
FIRST_DAMPING = 1e-2
EARLY_DAMPING = 1.0  # far from a minimum, where a full step would leave the bounds
EARLY_POINTS = 4  # random points: an early random search starts from the best of them
MAX_SEARCH_STEPS = 12
ENOUGH_GAIN = 1e-4  # relative gain of a step below which a full-record search ends
ENOUGH_PART_GAIN = 1e-2
FAR_FITNESS = 1.1  # times the champion's fitness: above, a search ends at the first small gain


@compile_borrowing
def _draw_best_start(
    evaluator: Evaluator, plan: IslandPlan, shape: tuple[int, int], search: SearchRecord
) -> FloatArray:
    """Draw random points and return the one that fits the record best up to the horizon."""
    points, horizon = np.empty(shape), search.horizon
    for p in range(shape[0]):
        for d in range(shape[1]):
            draw = 1 + p * shape[1] + d
            word = draw_words(plan.seed, USE_LOCAL_SEARCH, plan.island, search.generation, draw)
            points[p, d] = to_uniform(word[0])
    search.evaluations += shape[0]
    predicted = predict_partially(evaluator, from_unit(evaluator, points), horizon)
    fitness = evaluate_partial_fitness(evaluator, plan, predicted, horizon)
    return np.asarray(points[np.argmin(fitness[: shape[0]])])


@jit_compile
def _is_coloured(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> bool:
    """Return whether this turn asks for the champion's residuals, and they are more than noise.

    False near the end of a budget.
    """
    search = island.search
    if not asks_residuals(search):
        return False
    if search.evaluations + max(island.chromosomes.shape) + 2 > plan.most_evaluations:
        return False
    return is_champion_coloured(evaluator, plan, island)


@compile_borrowing
def start_local_search(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> None:
    """Choose the start of a local search, and the part of the record that it fits first."""
    chromosomes, search = island.chromosomes, island.search
    search.local_searches += 1
    search.in_sequence_search, search.step_count, search.failed_steps = True, 0, 0
    is_early = search.local_searches <= EARLY_SEARCHES
    search.damping = EARLY_DAMPING if is_early else FIRST_DAMPING
    search.reached_fitness, size = np.inf, chromosomes.shape[0]
    word = draw_words(plan.seed, USE_LOCAL_SEARCH, plan.island, search.generation, 0)
    is_coloured = _is_coloured(evaluator, plan, island)
    kind, individual = choose_local_search(size, word, is_coloured, search)
    begin_growth(kind, word, search)
    search.probe_count = size * kind.probes // 3
    begins, search.hop, search.hop_is_evidence = kind.begins, kind.hop, kind.is_evidence
    # The points of a random start, or the slopes of a hop, would exceed the budget.
    if search.evaluations + max(chromosomes.shape) + 1 > plan.most_evaluations:
        begins = AT_CHAMPION if begins == AT_RANDOM_POINT else begins
        search.hop, search.hop_is_evidence = NO_HOP, False
    search.from_random_start, search.replaced_fitness = begins == AT_RANDOM_POINT, np.inf
    if search.from_random_start:
        drawn = min(EARLY_POINTS, size) if is_early else size
        begin = _draw_best_start(evaluator, plan, (drawn, chromosomes.shape[1]), search)
    else:
        chosen = individual if begins == AT_INDIVIDUAL else 0
        begin = decode(chromosomes[chosen : chosen + 1], plan.bits)[0]
        if search.hop == NO_HOP:
            search.replaced_fitness = island.fitness[chosen]
    for d in range(begin.size):
        island.point[d] = begin[d]
    if search.hop != NO_HOP:
        hop_from_champion(evaluator, plan, island)


@compile_borrowing
def _replace_individual(island: IslandArrays, chromosome: WordArray, reached: float) -> None:
    """Replace the individual that the search started from, or else the worst one."""
    chromosomes, fitness, search = island.chromosomes, island.fitness, island.search
    index = fitness.size - 1
    for p in range(fitness.size - 1, -1, -1):
        if fitness[p] == search.replaced_fitness:
            index = p
    if reached < fitness[index]:
        for d in range(chromosome.size):
            chromosomes[index, d] = chromosome[d]
        fitness[index] = reached
        sort_population(chromosomes, fitness)
        search.replaced_fitness = reached


@compile_borrowing
def _scatter_population(
    island: IslandArrays, proposals: WordArray, reached: FloatArray, best: int
) -> None:
    """Replace all individuals but the champion by the probes; the genetic search continues."""
    chromosomes, fitness, search = island.chromosomes, island.fitness, island.search
    if search.probe_count < fitness.size:  # probes of a growing horizon stay for the next step
        return
    search.probe_count, search.stagnation = 0, 0
    for p in range(1, min(fitness.size, reached.size - N_TRIALS + 1)):
        t = N_TRIALS + p - 1
        if t != best:
            fitness[p] = reached[t]
            for d in range(chromosomes.shape[1]):
                chromosomes[p, d] = proposals[t, d]
    sort_population(chromosomes, fitness)


@jit_compile
def has_returned(search: SearchRecord, champion: float) -> bool:
    """Return whether a local search ended at the optimum of the champion, by its fitness."""
    return bool(abs(search.reached_fitness - champion) <= champion * SAME_OPTIMUM)


@jit_compile
def _extend_horizon(search: SearchRecord, champion: float) -> None:
    """Extend the part of the record that is fitted; at its end, end the local search.

    `champion` is the champion's fitness.
    """
    search.failed_steps = 0
    search.damping = FIRST_DAMPING
    if search.horizon < 1.0:
        search.horizon = min(search.horizon * search.horizon_growth, 1.0)
        return
    search.in_sequence_search, search.step_count = False, 0
    if search.replaced_fitness == champion and search.local_searches > 1:
        search.champion_converged = True
    if search.hop_is_evidence:
        search.hop_count += 1
        search.returned_hops += has_returned(search, champion)
    if search.from_random_start:
        search.random_starts += 1
        search.confirmed_starts += search.reached_fitness <= champion * (1.0 + SAME_OPTIMUM)


@compile_borrowing
def _finish_part(
    evaluator: Evaluator, plan: IslandPlan, island: IslandArrays, reached: float
) -> None:
    """Extend the horizon; end early if a far search near jumps is behind the champion."""
    search = island.search
    races = search.horizon < 1.0 and search.fitness_discontinuities > 0 and search.hop == NO_HOP
    if races and is_behind_champion(evaluator, plan, island, search.horizon, reached):
        search.horizon = 1.0
    _extend_horizon(search, island.fitness[0])
    has_ended = not search.in_sequence_search and np.isfinite(search.reached_fitness)
    if has_ended and search.from_random_start:
        archive_end(island.archive, island.point, search.reached_fitness)
    is_smooth_hop = search.hop_is_evidence and search.fitness_discontinuities == 0
    if has_ended and is_smooth_hop and has_returned(search, island.fitness[0]):
        search.champion_explained = is_champion_explained(evaluator, plan, island)


@compile_borrowing
def _propose_points(
    plan: IslandPlan, island: IslandArrays, matrix: FloatArray, gradient: FloatArray, base: float
) -> FloatArray:
    """Propose steps of several dampings, and probes drawn from the estimate's covariance."""
    point, search = island.point, island.search
    points = np.empty((N_TRIALS + search.probe_count, point.size))
    for t in range(N_TRIALS):
        damping = search.damping * DAMPING_FACTOR ** (t - 1)
        write_damped_step(matrix, gradient, point, damping, points[t])
    deviation, factor = np.empty(point.size), factor_damped(matrix, gradient, point, 0.0)
    for t in range(N_TRIALS, points.shape[0]):
        for d in range(point.size):
            draw = 1 + t * point.size + d
            word = draw_words(plan.seed, USE_LOCAL_SEARCH, plan.island, search.generation, draw)
            deviation[d] = base * 10.0 ** (1.5 - 2.5 * to_uniform(word[2])) * to_normal(word)
        write_spread_point(factor, point, deviation, points[t])
    return points


@compile_borrowing
def run_adaptive_sequence(evaluator: Evaluator, plan: IslandPlan, island: IslandArrays) -> None:
    """Run one generation of the adaptive search: sensitivities, then several steps at once."""
    point, search = island.point, island.search
    horizon = search.horizon
    search.step_count += 1
    search.evaluations += point.size + 1 + N_TRIALS + search.probe_count
    difference = choose_difference(plan, search)
    matrix, gradient, base = build_normal_equations(evaluator, plan, point, horizon, difference)
    proposals = encode(_propose_points(plan, island, matrix, gradient, base), plan.bits)
    points = decode(proposals, plan.bits)
    if horizon < 1.0:
        predicted = predict_partially(evaluator, from_unit(evaluator, points), horizon)
        reached = evaluate_partial_fitness(evaluator, plan, predicted, horizon)[: points.shape[0]]
    else:
        reached = evaluate_population(evaluator, from_unit(evaluator, points))
    best = np.argmin(reached)
    _scatter_population(island, proposals, reached, int(best))
    is_near = reached[best] < FAR_FITNESS * island.fitness[0]
    strict = is_near and horizon == 1.0 and search.local_searches > 1
    enough = ENOUGH_GAIN if strict else ENOUGH_PART_GAIN
    if reached[best] < base:
        for d in range(point.size):
            point[d] = points[best, d]
        search.damping *= DAMPING_FACTOR ** float(min(int(best), N_TRIALS) - 2)
        if horizon == 1.0:
            search.reached_fitness = reached[best]
            _replace_individual(island, proposals[best], reached[best])
        if reached[best] > base * (1.0 - enough) or search.step_count >= MAX_SEARCH_STEPS:
            _finish_part(evaluator, plan, island, reached[best])
        return
    search.damping *= DAMPING_FACTOR**N_TRIALS
    search.failed_steps += 1
    if search.failed_steps == 2 or not np.isfinite(base):
        _finish_part(evaluator, plan, island, base)
