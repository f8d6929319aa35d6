"""Starts for the search of a filter's likelihood, from free runs.

A filter with large noise predicts any smooth output from its own past, whatever the plant is. So
the likelihood has many poor minima, and is flat between them. The squares of a free run have wide
basins. They are biased by the noise, but near enough for a start.
"""

import numpy as np

from sysid.core.settings import GeneticAlgorithm
from sysid.core.threads import use_one_thread
from sysid.core.types import FloatArray
from sysid.search.island import compute_start_budget, get_island_settings
from sysid.search.refine import refine_candidates
from sysid.selection.starts import SearchStarts
from sysid.simulation.free_run import build_free_run
from sysid.simulation.noise_levels import add_noise_levels
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit

_BUDGET_SHARE = 4  # all starts take at most one in so many simulations of a budget
_DRAWN = 256  # random points
_REFINED = 16  # groups of them, of each of which the best is refined


def find_free_run_starts(problem: Problem, algorithm: GeneticAlgorithm, seed: int) -> SearchStarts:
    """Find starts for islands with the improved method; none for a model without a filter."""
    methods = {get_island_settings(algorithm, i).method for i in range(algorithm.n_islands)}
    if not problem.model.corrections or "improved" not in methods:
        return SearchStarts()
    limit = algorithm.stop.evaluations
    most = compute_start_budget(algorithm, len(problem.free_parameters))
    if limit is not None:
        most = min(most, limit // _BUDGET_SHARE)
    free = build_free_run(problem)
    if not free.free_parameters:
        return SearchStarts()
    with use_one_thread():  # so that the last bit does not depend on the number of cores
        ends, spent = _search_free_runs(free, seed, most)
        found: list[tuple[float, int, FloatArray]] = []
        for number, end in enumerate(ends):
            plant = dict(zip(free.free_names, end.tolist(), strict=True))
            theta = add_noise_levels(problem, plant)
            fitness = problem.evaluate_fitness(theta)
            spent += len(theta)
            best = int(np.argmin(fitness))
            if np.isfinite(fitness[best]):
                found.append((float(fitness[best]), number, theta[best]))
    starts = [theta.tolist() for _, _, theta in sorted(found, key=lambda one: one[:2])]
    names = problem.free_names
    return SearchStarts(tuple(dict(zip(names, one, strict=True)) for one in starts), spent)


def _search_free_runs(free: Problem, seed: int, most: int) -> tuple[list[FloatArray], int]:
    """Refine the best of each group of random points in free runs."""
    random = np.random.default_rng([seed, len(free.free_names)])
    drawn = max(min(_DRAWN, most // 2), 1)
    theta = from_unit(free.evaluator, random.random((drawn, len(free.free_names))))
    fitness = free.evaluate_fitness(theta)
    groups = np.array_split(np.arange(drawn), min(_REFINED, drawn))
    chosen = [group[np.argmin(fitness[group])] for group in groups]
    points = [theta[i] for i in chosen if np.isfinite(fitness[i])]
    if not points:
        return [], drawn
    found = [one for one in refine_candidates(free, points, most - drawn) if one is not None]
    spent = drawn + len(points) + sum(one.evaluations for one in found)
    return [one.theta for one in found], spent
