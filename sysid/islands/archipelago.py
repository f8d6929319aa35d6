"""The islands of one run: their sizes, their search plans and their initial populations."""

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.settings import SEED, GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.search.archive import make_archive
from sysid.search.evolution import draw_initial_points
from sysid.search.island import (
    Island,
    _compute_island_budget,
    get_island_settings,
    get_target_rms,
    split_population,
)
from sysid.search.operators import USE_WARM_START, draw_words, encode, to_uniform
from sysid.search.state import (
    METHOD_IMPROVED,
    METHOD_IMPROVED_FIXED_SEQUENCE,
    METHOD_PAPER,
    METHOD_SIMPLE,
    SEARCH_RECORD,
    IslandPlan,
)
from sysid.simulation.problem import Problem, compute_record_progress
from sysid.simulation.scaling import to_unit

_WARM_SHARE = 4  # one individual in four of a warm start comes from the earlier values
_WARM_SPREAD = 0.1  # of the range


def make_plans(problem: Problem, algorithm: GeneticAlgorithm, seed: int) -> tuple[IslandPlan, ...]:
    """Make the search plan of each island."""
    progress = compute_record_progress(problem)
    shared = make_shared_plans(algorithm, len(problem.free_parameters), problem.loss_scale)
    return tuple(plan._replace(seed=seed, progress=progress) for plan in shared)


@lru_cache(maxsize=64)
def make_shared_plans(algorithm: GeneticAlgorithm, n: int, scale: float) -> tuple[IslandPlan, ...]:
    """Make the plans that all runs of n parameters share. Their arrays must not be modified."""
    sizes = split_population(algorithm)
    plans = []
    for index, size in enumerate(sizes):
        settings = get_island_settings(algorithm, index)
        plans.append(
            IslandPlan(
                seed=0,
                island=index,
                first_individual=sum(sizes[:index]),
                population=algorithm.population,
                method=_encode_method(settings),
                bits=settings.bits,
                survivors=min(max(2, round(settings.selection_rate * size)), size - 1),
                stagnation=settings.stagnation,
                is_relative=int(settings.sequence.relative),
                most_evaluations=_compute_island_budget(settings, n, size),
                beta=float(settings.sequence.beta),
                target_rms=get_target_rms(settings),
                loss_scale=scale,
                mutation_starts=np.array([start for start, _ in settings.mutation], dtype=np.int64),
                mutation_rates=np.array([rate for _, rate in settings.mutation], dtype=np.float64),
                progress=np.zeros(0),
            )
        )
    return tuple(plans)


def _encode_method(algorithm: GeneticAlgorithm) -> int:
    match algorithm.method:
        case "simple":
            return METHOD_SIMPLE
        case "improved-paper":
            return METHOD_PAPER
        case "improved":
            return (
                METHOD_IMPROVED
                if algorithm.sequence.kind == "adaptive"
                else METHOD_IMPROVED_FIXED_SEQUENCE
            )


def create_islands(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    seed: int,
    warm: Sequence[Mapping[str, float]] = (),
    starts: Sequence[Mapping[str, float]] = (),
    spent: int = 0,
) -> tuple[Island, ...]:
    """Create the islands before their first generation; no individual is evaluated yet.

    A quarter of every island comes from the `warm` parameter values: first the values themselves,
    then neighbours of them. The rest is drawn at random. Islands with the improved method also
    share the `starts`, best first. Computing the starts took `spent` simulations.
    """
    if not SEED.hold(seed):
        raise InvalidSettings("/seed", f"found {seed!r}; need {SEED}")
    n = len(problem.free_parameters)
    if n == 0:
        raise InvalidSettings("/parameters", "every parameter is fixed. Leave at least one free")
    plans = make_shared_plans(algorithm, n, problem.loss_scale)
    ends = np.cumsum(split_population(algorithm))
    sizes, methods = np.diff(ends, prepend=0), np.array([plan.method for plan in plans])
    individuals = draw_initial_points(seed, algorithm.population, methods, sizes, n)
    search, points = np.zeros(len(plans), SEARCH_RECORD), np.zeros((len(plans), n))
    search["evaluations"][0] = spent
    islands = []
    for i, (plan, size, end) in enumerate(zip(plans, sizes.tolist(), ends.tolist(), strict=True)):
        own = individuals[end - size : end]
        improves = plan.method in (METHOD_IMPROVED, METHOD_IMPROVED_FIXED_SEQUENCE)
        island_starts = starts[i % max(len(starts), 1) :: len(plans)] if improves else ()
        values = (*warm, *island_starts)
        for p in range(max(1, size // _WARM_SHARE) if values else 0):
            shift_seed = seed if p >= len(values) else None
            _place_warm_start(problem, plan.island, values[p % len(values)], p, own, shift_seed)
        islands.append(
            Island(
                i,
                seed,
                encode(own, plan.bits),
                np.full(size, np.nan),
                search[i, ...],
                points[i],
                make_archive(n),
            )
        )
    return tuple(islands)


def _place_warm_start(
    problem: Problem,
    island: int,
    values: Mapping[str, float],
    p: int,
    individuals: FloatArray,
    seed: int | None,
) -> None:
    """Replace individual `p` by start values, or with a seed by a neighbour of them."""
    theta = np.array(
        [[values.get(q.name, 0.5 * (q.lower + q.upper)) for q in problem.free_parameters]]
    )
    start = to_unit(problem.evaluator, theta)[0]
    for d, parameter in enumerate(problem.free_parameters):
        if parameter.name in values:
            shift = 0.0
            if seed is not None:
                word = draw_words(seed, USE_WARM_START, island, p, d)
                shift = _WARM_SPREAD * (2.0 * to_uniform(word[0]) - 1.0)
            individuals[p, d] = min(max(start[d] + shift, 0.0), 1.0)
