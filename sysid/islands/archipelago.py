"""The islands of one run: how many individuals each has, how each searches, how all begin."""

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.search.evolution import draw_initial_places
from sysid.search.island import (
    NO_TARGET_RMS,
    Island,
    _compute_island_budget,
    get_island_settings,
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

_WARM_SHARE = 4  # one individual in four of a warm start comes from the given values
_WARM_SPREAD = 0.1  # of the range


def make_plans(problem: Problem, algorithm: GeneticAlgorithm, seed: int) -> tuple[IslandPlan, ...]:
    """How each island searches."""
    progress = compute_record_progress(problem)
    alike = make_shared_plans(algorithm, len(problem.free_parameters), problem.loss_scale)
    return tuple(plan._replace(seed=seed, progress=progress) for plan in alike)


@lru_cache(maxsize=64)
def make_shared_plans(algorithm: GeneticAlgorithm, n: int, scale: float) -> tuple[IslandPlan, ...]:
    """What the plans of all runs of n parameters share; their arrays are not to be written to."""
    dealt = split_population(algorithm)
    made = []
    for index, size in enumerate(dealt):
        own = get_island_settings(algorithm, index)
        made.append(
            IslandPlan(
                seed=0,
                island=index,
                first_individual=sum(dealt[:index]),
                population=algorithm.population,
                method=_encode_method(own),
                bits=own.bits,
                survivors=min(max(2, round(own.selection_rate * size)), size - 1),
                stagnation=own.stagnation,
                is_relative=int(own.sequence.relative),
                most_evaluations=_compute_island_budget(own, n, size),
                beta=float(own.sequence.beta),
                target_rms=NO_TARGET_RMS if own.stop.rms is None else float(own.stop.rms),
                loss_scale=scale,
                mutation_starts=np.array([start for start, _ in own.mutation], dtype=np.int64),
                mutation_rates=np.array([rate for _, rate in own.mutation], dtype=np.float64),
                progress=np.zeros(0),
            )
        )
    return tuple(made)


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
    """The islands before their first generation; no individual is evaluated yet.

    A quarter of every island comes from the `warm` parameter values (in turn: the values
    themselves, then neighbours), the rest is drawn. Those that search by the improved method
    also share the `starts`, best first, whose finding took `spent` simulations.
    """
    if not 0 <= seed < 2**63:
        raise InvalidSettings("/seed", f"found {seed!r}; need a whole number 0 to 2^63 - 1")
    n = len(problem.free_parameters)
    if n == 0:
        raise InvalidSettings("/parameters", "every parameter is fixed; leave at least one free")
    islands, n_islands = [], algorithm.n_islands
    for plan, size in zip(
        make_plans(problem, algorithm, seed), split_population(algorithm), strict=True
    ):
        places = draw_initial_places(plan, size, n)
        improves = plan.method in (METHOD_IMPROVED, METHOD_IMPROVED_FIXED_SEQUENCE)
        mine = starts[plan.island % max(len(starts), 1) :: n_islands] if improves else ()
        given = (*warm, *mine)
        for p in range(max(1, size // _WARM_SHARE) if given else 0):
            _place_warm_start(problem, plan, given[p % len(given)], p, places, p >= len(given))
        search = np.zeros((), SEARCH_RECORD).view(np.recarray)
        search.evaluations = spent if plan.island == 0 else 0
        islands.append(
            Island(
                plan.island,
                seed,
                encode(places, plan.bits),
                np.full(size, np.nan),
                search,
                np.zeros(n),
            )
        )
    return tuple(islands)


def _place_warm_start(
    problem: Problem,
    plan: IslandPlan,
    values: Mapping[str, float],
    p: int,
    places: FloatArray,
    shifted: bool,
) -> None:
    """Put given values, or a neighbour of them, in the place of individual `p`."""
    theta = np.array(
        [[values.get(q.name, 0.5 * (q.lower + q.upper)) for q in problem.free_parameters]]
    )
    given = to_unit(problem.evaluator, theta)[0]
    for d, parameter in enumerate(problem.free_parameters):
        if parameter.name in values:
            word = draw_words(plan.seed, USE_WARM_START, plan.island, p, d)
            shift = _WARM_SPREAD * (2.0 * to_uniform(word[0]) - 1.0) if shifted else 0.0
            places[p, d] = min(max(given[d] + shift, 0.0), 1.0)
