"""The islands of one run: how many individuals each has, how each searches, how all begin."""

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.search.evolution import initial_places
from sysid.search.island import NEVER, Island, _island_budget, of_island, sizes
from sysid.search.operators import WARM, coded, draws, unit
from sysid.search.state import (
    IMPROVED,
    IMPROVED_PAPER_STEPS,
    PAPER,
    SEARCH_RECORD,
    SIMPLE,
    Plan,
)
from sysid.simulation.problem import Problem, record_progress
from sysid.simulation.scaling import placed

_WARM_SHARE = 4  # one individual in four of a warm start comes from the given values
_WARM_SPREAD = 0.1  # of the range


def plans(problem: Problem, algorithm: GeneticAlgorithm, seed: int) -> tuple[Plan, ...]:
    """How each island searches."""
    progress = record_progress(problem)
    alike = shared_plans(algorithm, len(problem.space), problem.loss_scale)
    return tuple(plan._replace(seed=seed, progress=progress) for plan in alike)


@lru_cache(maxsize=64)
def shared_plans(algorithm: GeneticAlgorithm, n: int, scale: float) -> tuple[Plan, ...]:
    """What the plans of all runs of n parameters share; their arrays are not to be written to."""
    dealt = sizes(algorithm)
    made = []
    for index, size in enumerate(dealt):
        own = of_island(algorithm, index)
        made.append(
            Plan(
                seed=0,
                island=index,
                first=sum(dealt[:index]),
                total=algorithm.population,
                method=_method(own),
                bits=own.bits,
                survivors=min(max(2, round(own.selection_rate * size)), size - 1),
                stagnation=own.stagnation,
                relative=int(own.sequence.relative),
                evaluations=_island_budget(own, n, size),
                beta=float(own.sequence.beta),
                rms=NEVER if own.stop.rms is None else float(own.stop.rms),
                loss_scale=scale,
                starts=np.array([start for start, _ in own.mutation], dtype=np.int64),
                rates=np.array([rate for _, rate in own.mutation], dtype=np.float64),
                progress=np.zeros(0),
            )
        )
    return tuple(made)


def _method(algorithm: GeneticAlgorithm) -> int:
    match algorithm.method:
        case "simple":
            return SIMPLE
        case "improved-paper":
            return PAPER
        case "improved":
            return IMPROVED if algorithm.sequence.kind == "adaptive" else IMPROVED_PAPER_STEPS


def found(
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
    n = len(problem.space)
    if n == 0:
        raise InvalidSettings("/parameters", "every parameter is fixed; leave at least one free")
    islands, n_islands = [], algorithm.n_islands
    for plan, size in zip(plans(problem, algorithm, seed), sizes(algorithm), strict=True):
        places = initial_places(plan, size, n)
        improves = plan.method in (IMPROVED, IMPROVED_PAPER_STEPS)
        mine = starts[plan.island % max(len(starts), 1) :: n_islands] if improves else ()
        given = (*warm, *mine)
        for p in range(max(1, size // _WARM_SHARE) if given else 0):
            _warm(problem, plan, given[p % len(given)], p, places, p >= len(given))
        search = np.zeros((), SEARCH_RECORD).view(np.recarray)
        search.evaluations = spent if plan.island == 0 else 0
        islands.append(
            Island(
                plan.island,
                seed,
                coded(places, plan.bits),
                np.full(size, np.nan),
                search,
                np.zeros(n),
            )
        )
    return tuple(islands)


def _warm(
    problem: Problem,
    plan: Plan,
    values: Mapping[str, float],
    p: int,
    places: FloatArray,
    shifted: bool,
) -> None:
    """Put given values, or a neighbour of them, in the place of individual `p`."""
    theta = np.array([[values.get(q.name, 0.5 * (q.lower + q.upper)) for q in problem.space]])
    given = placed(problem.evaluator, theta)[0]
    for d, parameter in enumerate(problem.space):
        if parameter.name in values:
            word = draws(plan.seed, WARM, plan.island, p, d)
            shift = _WARM_SPREAD * (2.0 * unit(word[0]) - 1.0) if shifted else 0.0
            places[p, d] = min(max(given[d] + shift, 0.0), 1.0)
