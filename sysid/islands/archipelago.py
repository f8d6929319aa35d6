"""The islands of one run: how many individuals each has, how each searches, how all begin."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from sysid.errors import InvalidSettings
from sysid.ga.chromosome import coded, placed
from sysid.ga.development import TRIALS
from sysid.ga.evolution import initial_places
from sysid.ga.island import Island
from sysid.ga.random import WARM, draws, unit
from sysid.ga.state import (
    EVALUATIONS,
    IMPROVED,
    IMPROVED_PAPER_STEPS,
    N_COUNTERS,
    PAPER,
    POINT,
    SIMPLE,
    Plan,
)  # fmt: skip
from sysid.kernels.calls import LANES
from sysid.problem import Problem
from sysid.settings import GeneticAlgorithm, Loss
from sysid.types import FloatArray

_UNLIMITED = 2**62
NEVER = -1.0
_WARM_SHARE = 4  # one individual in four of a warm start comes from the given values
_WARM_SPREAD = 0.1  # of the range


def sizes(algorithm: GeneticAlgorithm) -> tuple[int, ...]:
    """Individuals of each island: the population dealt as evenly as possible."""
    each, more = divmod(algorithm.population, algorithm.n_islands)
    return tuple(each + (i < more) for i in range(algorithm.n_islands))


def of_island(algorithm: GeneticAlgorithm, index: int) -> GeneticAlgorithm:
    """The settings of one island, where islands differ."""
    if not isinstance(algorithm.islands, tuple):
        return algorithm
    change = algorithm.islands[index]
    return replace(
        algorithm,
        method=change.method or algorithm.method,
        bits=change.bits or algorithm.bits,
        mutation=change.mutation or algorithm.mutation,
    )


def search_budget(algorithm: GeneticAlgorithm, n: int) -> int:
    """Simulations that the islands may run: all but a tenth kept for the refinement.

    At least a few steps of the refinement (of n + 1 simulations) and at most half are kept, and
    what the last step of each island may take beyond its share.
    """
    limit = algorithm.stop.evaluations
    if limit is None:
        return _UNLIMITED
    if not algorithm.refine:
        return limit
    beyond = algorithm.n_islands * (n + LANES)
    return limit - min(max(limit // 10, 4 * (n + 2)) + beyond, limit // 2)


def analysis_budget(n: int) -> int:
    """Simulations kept for the standard errors of n parameters.

    They take two a parameter, beside jumps of the output ten more, and a look at what cannot be
    told two more.
    """
    return 14 * n + 1


def _island_budget(algorithm: GeneticAlgorithm, n: int, size: int) -> int:
    """Simulations from which on an island begins no other generation.

    Its share of `search_budget`; of a tiny budget less, so that its last generation does not take
    it beyond its share of what the standard errors leave.
    """
    limit = algorithm.stop.evaluations
    if limit is None:
        return _UNLIMITED
    share = search_budget(algorithm, n) * size // algorithm.population
    left = max(limit - analysis_budget(n), algorithm.population) * size // algorithm.population
    return max(1, min(share, left - _generation(n, size) + 1))


def _generation(n: int, size: int) -> int:
    """Simulations of one generation of an island at most."""
    return size + n + 1 + TRIALS


def budget_before(algorithm: GeneticAlgorithm, n: int) -> int:
    """What the islands and the standard errors leave of the budget to the finding of starts.

    It counts as the first island's work, which may be less than its share for that.
    """
    limit = algorithm.stop.evaluations
    if limit is None:
        return _UNLIMITED
    taken = 0
    for size in sizes(algorithm)[1:]:
        rests = _island_budget(algorithm, n, size)
        taken += size if rests <= size else rests - 1 + _generation(n, size)
    return max(0, limit - (2 * n + 1) - sizes(algorithm)[0] - taken)


def plans(problem: Problem, algorithm: GeneticAlgorithm, seed: int) -> tuple[Plan, ...]:
    """How each island searches."""
    progress = record_progress(problem)
    alike = shared_plans(algorithm, len(problem.space), loss_scale(problem))
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


def loss_scale(problem: Problem) -> float:
    """Scale of the soft-l1 loss, 0 for squares: what compiled code is told."""
    loss = next(a for a in problem.arguments if isinstance(a, Loss))
    return float(loss.scale) if loss.kind == "soft-l1" else 0.0


def _method(algorithm: GeneticAlgorithm) -> int:
    match algorithm.method:
        case "simple":
            return SIMPLE
        case "improved-paper":
            return PAPER
        case "improved":
            return IMPROVED if algorithm.sequence.kind == "adaptive" else IMPROVED_PAPER_STEPS


def record_progress(problem: Problem) -> FloatArray:
    """Part of its experiment (0 … 1) that has to be simulated for each of the M measured values."""
    return np.concatenate([
        np.ceil(samples.places) / max(experiment.grid.points - 1, 1)
        for experiment in problem.experiments for samples in experiment.outputs
    ])  # fmt: skip


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
        counters = np.zeros(N_COUNTERS, dtype=np.int64)
        counters[EVALUATIONS] = spent if plan.island == 0 else 0
        islands.append(
            Island(
                plan.island,
                seed,
                coded(places, plan.bits),
                np.full(size, np.nan),
                counters,
                np.zeros(POINT + n),
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
