"""All islands of a run evolved in one compiled call: generations, migration, a look at the end.

Between two calls nothing has to be decided, so a call may end anywhere: the result is that of
islands that evolve one after the other up to each border, and migrate there.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray, IntArray
from sysid.islands.archipelago import make_shared_plans
from sysid.islands.migration import MigrationRoutes, exchange_migrants, make_routes
from sysid.islands.packed import (
    EvolutionLog,
    PackedIslands,
    allocate_log,
    list_migrants,
    pack_islands,
    unpack_islands,
)
from sysid.islands.stopping import StoppingRule, has_process_ended
from sysid.search.evolution import is_done, run_generations
from sysid.search.island import NO_TARGET_RMS, Island
from sysid.search.state import COLUMN_RMS, COLUMN_VALUES, IslandArrays, IslandPlan, Migrant
from sysid.simulation.evaluator import Evaluator
from sysid.simulation.problem import Problem, compute_record_progress

_CHECK_INTERVAL = 5  # generations between two looks at the target RMS, or at a warm start
_MOST_BORDERS, _MOST_MIGRANTS = 100, 100_000
"""Borders that one call passes at most, and migrants that it has room for."""


_INTEGER_FIELDS = (
    "island",
    "first_individual",
    "method",
    "bits",
    "survivors",
    "stagnation",
    "is_relative",
    "most_evaluations",
)


class PackedPlans(NamedTuple):
    """The plans of all islands; `own` and `floats` have what differs.

    See `sysid.search.state.IslandPlan`.

    Attributes
    ----------
    seed, total : int
    loss_scale : float
    progress : FloatArray, shape (M,)
    own : IntArray, shape (I, 8)
        Those of `_INTEGER_FIELDS`.
    floats : FloatArray, shape (I, 2)
        beta, rms.
    starts, rates : arrays, shape (I, S)
        Shorter mutation schedules end with their last entry repeated.
    """

    seed: int
    population: int
    loss_scale: float
    progress: FloatArray
    integers: IntArray
    floats: FloatArray
    mutation_starts: IntArray
    mutation_rates: FloatArray


class SearchPlan(NamedTuple):
    """What the islands of a run do, up to its end.

    Attributes
    ----------
    step, every : int
        Generations from border to border at most, and from one migration to the next.
    borders : int
        After so many borders a call ends.
    """

    plans: PackedPlans
    routes: MigrationRoutes
    stopping_rule: StoppingRule
    border_interval: int
    migration_interval: int
    most_borders: int


class ArchipelagoState(NamedTuple):
    """Where a run stands after a call; `has_crossed`: at a border that it has just passed."""

    islands: tuple[Island, ...]
    migrants: tuple[Migrant, ...]
    generation: int
    epoch: int
    has_crossed: bool


def make_search_plan(
    problem: Problem, algorithm: GeneticAlgorithm, seed: int, *, is_warm: bool
) -> SearchPlan:
    """The course of a run; `is_warm`: an earlier result stands behind it."""
    way = _make_shared_search_plan(
        algorithm, len(problem.free_parameters), problem.loss_scale, is_warm
    )
    own = way.plans._replace(seed=seed, progress=compute_record_progress(problem))
    return way._replace(plans=own)


def make_stopping_rule(algorithm: GeneticAlgorithm, *, is_warm: bool) -> StoppingRule:
    """When a run ends."""
    stop = algorithm.stop
    target = NO_TARGET_RMS if stop.rms is None else float(stop.rms)
    return StoppingRule(algorithm.generations, target, stop.settled or 0, is_warm)


def get_border_interval(algorithm: GeneticAlgorithm, *, is_warm: bool) -> int:
    """Generations from one border to the next at most."""
    looks_often = algorithm.stop.rms is not None or is_warm
    return (
        min(algorithm.migration.every, _CHECK_INTERVAL)
        if looks_often
        else algorithm.migration.every
    )


@lru_cache(maxsize=64)
def _make_shared_search_plan(
    algorithm: GeneticAlgorithm, n: int, scale: float, is_warm: bool
) -> SearchPlan:
    """What the courses of all runs of n parameters share; its arrays are not to be written to."""
    planned = make_shared_plans(algorithm, n, scale)
    longest = max(plan.mutation_starts.size for plan in planned)
    plans = PackedPlans(
        0,
        algorithm.population,
        scale,
        np.zeros(0),
        np.array(
            [[getattr(plan, name) for name in _INTEGER_FIELDS] for plan in planned], dtype=np.int64
        ),
        np.array([(plan.beta, plan.target_rms) for plan in planned]),
        np.array([_pad_schedule(plan.mutation_starts, longest) for plan in planned]),
        np.array([_pad_schedule(plan.mutation_rates, longest) for plan in planned]),
    )
    ways = make_routes([plan.bits for plan in planned], algorithm.migration, algorithm.population)
    room = _MOST_MIGRANTS // max(1, len(ways.edges) * ways.most_migrants)
    borders = (
        1 if is_warm else max(1, min(_MOST_BORDERS, room))
    )  # a warm one's history is looked at
    return SearchPlan(
        plans,
        ways,
        make_stopping_rule(algorithm, is_warm=is_warm),
        get_border_interval(algorithm, is_warm=is_warm),
        algorithm.migration.every,
        borders,
    )


def evolve_islands(
    evaluator: Evaluator,
    way: SearchPlan,
    islands: Sequence[Island],
    generation: int,
    epoch: int,
    budget: int,
) -> ArchipelagoState:
    """The islands of a run after at most `budget` generations of all of them together.

    Parameters
    ----------
    generation, epoch : int
        The last border, and migrations until then.
    """
    fleet, edges = pack_islands(islands), len(way.routes.edges)
    news = allocate_log(
        budget + way.most_borders * (len(islands) + edges),
        way.most_borders * edges * way.routes.most_migrants,
        fleet.champions.shape[1],
    )
    at, epoch, has_crossed = _run_epochs(evaluator, way, fleet, generation, epoch, budget, news)
    return ArchipelagoState(
        unpack_islands(fleet, news, islands), list_migrants(news), at, epoch, has_crossed
    )


def _pad_schedule(values: IntArray | FloatArray, size: int) -> IntArray | FloatArray:
    return np.concatenate([values, np.repeat(values[-1:], size - values.size)])


@jit_compile
def unpack_plan(plans: PackedPlans, i: int) -> IslandPlan:
    """The plan of one island."""
    own, floats = plans.integers[i], plans.floats[i]
    return IslandPlan(
        plans.seed,
        own[0],
        own[1],
        plans.population,
        own[2],
        own[3],
        own[4],
        own[5],
        own[6],
        own[7],
        floats[0],
        floats[1],
        plans.loss_scale,
        plans.mutation_starts[i],
        plans.mutation_rates[i],
        plans.progress,
    )


@jit_compile
def compute_next_border(generation: int, step: int, every: int, generations_: int) -> int:
    """The generation up to which all islands evolve alone."""
    return min(generation + min(step, every - generation % every), generations_)


@jit_compile
def _run_epochs(
    evaluator: Evaluator,
    way: SearchPlan,
    fleet: PackedIslands,
    generation: int,
    epoch: int,
    budget: int,
    news: EvolutionLog,
) -> tuple[int, int, bool]:
    """Go on in place; gives the last border, the migrations and whether it was passed just now."""
    for _ in range(way.most_borders):
        target = compute_next_border(
            generation,
            way.border_interval,
            way.migration_interval,
            way.stopping_rule.most_generations,
        )
        budget = _evolve_to_border(evaluator, way.plans, fleet, target, budget, news)
        if budget < 0:
            return generation, epoch, False
        generation = target
        if generation % way.migration_interval == 0 and fleet.champion_rms.size > 1:
            exchange_migrants(way.routes, fleet, epoch, news)
            epoch += 1
        if has_process_ended(
            way.stopping_rule, generation, fleet.champion_rms, fleet.search, False
        ):
            break
    return generation, epoch, True


@jit_compile
def _evolve_to_border(
    evaluator: Evaluator,
    plans: PackedPlans,
    fleet: PackedIslands,
    target: int,
    budget: int,
    news: EvolutionLog,
) -> int:
    """Evolve every island up to a border; gives what is left of the budget, −1 if too little."""
    for i in range(fleet.champion_rms.size):
        begin, end = fleet.offsets[i], fleet.offsets[i + 1]
        plan, search, written = unpack_plan(plans, i), fleet.search[i], news.counts[0]
        island = IslandArrays(
            fleet.chromosomes[begin:end], fleet.fitness[begin:end], search, fleet.points[i]
        )
        if search.generation >= target or is_island_resting(plan, island, fleet.champion_rms[i]):
            continue
        if budget == 0:
            return -1
        before, rows = search.generation, news.improvements[written:]
        made = run_generations(evaluator, plan, min(target - before, budget), island, rows)
        _record_improvements(fleet, i, made, news)
        budget -= search.generation - before
        if search.generation < target and not is_island_resting(
            plan, island, fleet.champion_rms[i]
        ):
            return -1
    return budget


@jit_compile
def is_island_resting(plan: IslandPlan, island: IslandArrays, rms: float) -> bool:
    """Whether an island has used up its evaluations or reached the target RMS.

    Not before its population is evaluated: finding the starts of a polynomial counts, too.
    """
    if np.all(np.isnan(island.fitness)):
        return False
    return is_done(plan, island.search, rms)


@jit_compile
def _record_improvements(fleet: PackedIslands, island: int, made: int, news: EvolutionLog) -> None:
    """Whose the improvements just written are, and the champion that the last one is."""
    for r in range(news.counts[0], news.counts[0] + made):
        news.improvement_islands[r] = island
    news.counts[0] += made
    if made:
        last = news.improvements[news.counts[0] - 1]
        fleet.champion_rms[island] = last[COLUMN_RMS]
        for d in range(fleet.champions.shape[1]):
            fleet.champions[island, d] = last[COLUMN_VALUES + d]
