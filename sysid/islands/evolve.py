"""All islands of a run evolved in one compiled call: generations, migration, stopping.

A border is a generation at which all islands meet, to migrate and to check the stopping rule. No
decision falls between two calls, so a call may end anywhere. The result is the same as if the
islands evolved one after the other up to each border.
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
from sysid.islands.stopping import StoppingRule, has_search_ended, make_stopping_rule
from sysid.kernels.borrowing import compile_borrowing
from sysid.search.evolution import is_done, repeats_chromosomes, run_generations
from sysid.search.island import Island
from sysid.search.known_fitness import get_island_memory, make_known_fitness
from sysid.search.state import (
    COLUMN_RMS,
    COLUMN_VALUES,
    IslandArrays,
    IslandPlan,
    KnownFitness,
    Migrant,
)
from sysid.simulation.evaluator import Evaluator
from sysid.simulation.problem import Problem, compute_record_progress

_CHECK_INTERVAL = 5  # generations between two checks of the target RMS, or of a warm start
_MAX_BORDERS, _MAX_MIGRANTS = 100, 100_000
"""Limits of one call: the borders it passes, and the migrants it has room for."""


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
    """The plans of all islands; `integers` and `floats` hold what differs between them.

    See `sysid.search.state.IslandPlan`.

    Attributes
    ----------
    seed, population : int
    loss_scale : float
    progress : FloatArray, shape (M,)
    integers : IntArray, shape (I, 8)
        The fields of `_INTEGER_FIELDS`.
    floats : FloatArray, shape (I, 2)
        beta, target_rms.
    mutation_starts, mutation_rates : arrays, shape (I, S)
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
    """The search plan of a run: island plans, migration routes and stopping rule.

    Attributes
    ----------
    border_interval, migration_interval : int
        Generations from one border to the next at most, and from one migration to the next.
    most_borders : int
        A call ends after so many borders.
    """

    plans: PackedPlans
    routes: MigrationRoutes
    stopping_rule: StoppingRule
    border_interval: int
    migration_interval: int
    most_borders: int


class ArchipelagoState(NamedTuple):
    """State of a run after a call; `has_crossed`: it has just passed a border."""

    islands: tuple[Island, ...]
    migrants: tuple[Migrant, ...]
    generation: int
    epoch: int
    has_crossed: bool


def make_search_plan(
    problem: Problem, algorithm: GeneticAlgorithm, seed: int, *, is_warm: bool
) -> SearchPlan:
    """Make the search plan of a run; `is_warm`: it starts from an earlier result."""
    shared_plan = _make_shared_search_plan(
        algorithm, len(problem.free_parameters), problem.loss_scale, is_warm
    )
    plans = shared_plan.plans._replace(seed=seed, progress=compute_record_progress(problem))
    return shared_plan._replace(plans=plans)


def get_border_interval(algorithm: GeneticAlgorithm, *, is_warm: bool) -> int:
    """Get the largest number of generations from one border to the next."""
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
    """Make the plan that all runs of n parameters share. Its arrays must not be modified."""
    island_plans = make_shared_plans(algorithm, n, scale)
    longest = max(plan.mutation_starts.size for plan in island_plans)
    plans = PackedPlans(
        0,
        algorithm.population,
        scale,
        np.zeros(0),
        np.array(
            [[getattr(plan, name) for name in _INTEGER_FIELDS] for plan in island_plans],
            dtype=np.int64,
        ),
        np.array([(plan.beta, plan.target_rms) for plan in island_plans]),
        np.array([_pad_schedule(plan.mutation_starts, longest) for plan in island_plans]),
        np.array([_pad_schedule(plan.mutation_rates, longest) for plan in island_plans]),
    )
    routes = make_routes(
        [plan.bits for plan in island_plans], algorithm.migration, algorithm.population
    )
    room = _MAX_MIGRANTS // max(1, len(routes.edges) * routes.most_migrants)
    borders = (
        1 if is_warm else max(1, min(_MAX_BORDERS, room))
    )  # the history of a warm run is checked at each border
    return SearchPlan(
        plans,
        routes,
        make_stopping_rule(algorithm, is_warm=is_warm),
        get_border_interval(algorithm, is_warm=is_warm),
        algorithm.migration.every,
        borders,
    )


def evolve_islands(
    evaluator: Evaluator,
    plan: SearchPlan,
    islands: Sequence[Island],
    generation: int,
    epoch: int,
    budget: int,
) -> ArchipelagoState:
    """Evolve the islands of a run by at most `budget` generations, summed over the islands.

    Parameters
    ----------
    generation, epoch : int
        The last border, and the number of migrations until then.
    """
    packed, edges = pack_islands(islands), len(plan.routes.edges)
    log = allocate_log(
        budget + plan.most_borders * (len(islands) + edges),
        plan.most_borders * edges * plan.routes.most_migrants,
        packed.champions.shape[1],
    )
    border, epoch, has_crossed = _run_epochs(
        evaluator, plan, packed, generation, epoch, budget, log
    )
    return ArchipelagoState(
        unpack_islands(packed, log, islands), list_migrants(log), border, epoch, has_crossed
    )


def _pad_schedule(values: IntArray | FloatArray, size: int) -> IntArray | FloatArray:
    return np.concatenate([values, np.repeat(values[-1:], size - values.size)])


@jit_compile
def unpack_plan(plans: PackedPlans, i: int) -> IslandPlan:
    """Extract the plan of one island."""
    integers, floats = plans.integers[i], plans.floats[i]
    return IslandPlan(
        plans.seed,
        integers[0],
        integers[1],
        plans.population,
        integers[2],
        integers[3],
        integers[4],
        integers[5],
        integers[6],
        integers[7],
        floats[0],
        floats[1],
        plans.loss_scale,
        plans.mutation_starts[i],
        plans.mutation_rates[i],
        plans.progress,
    )


@jit_compile
def compute_next_border(
    generation: int, border_interval: int, migration_interval: int, most_generations: int
) -> int:
    """Compute the generation up to which the islands evolve without exchange."""
    return min(
        generation + min(border_interval, migration_interval - generation % migration_interval),
        most_generations,
    )


@compile_borrowing
def _run_epochs(
    evaluator: Evaluator,
    plan: SearchPlan,
    packed: PackedIslands,
    generation: int,
    epoch: int,
    budget: int,
    log: EvolutionLog,
) -> tuple[int, int, bool]:
    """Evolve in place; return the last border, the migrations and whether it was just passed."""
    known = _make_memories(plan.plans, packed.champions.shape[1])
    for _ in range(plan.most_borders):
        target = compute_next_border(
            generation,
            plan.border_interval,
            plan.migration_interval,
            plan.stopping_rule.most_generations,
        )
        budget = _evolve_to_border(evaluator, plan.plans, packed, known, target, budget, log)
        if budget < 0:
            return generation, epoch, False
        generation = target
        if generation % plan.migration_interval == 0 and packed.champion_rms.size > 1:
            exchange_migrants(plan.routes, packed, epoch, log)
            epoch += 1
        if has_search_ended(
            plan.stopping_rule, generation, packed.champion_rms, packed.search, False
        ):
            break
    return generation, epoch, True


@jit_compile
def _make_memories(plans: PackedPlans, n: int) -> KnownFitness:
    """Make memories of fitness for all islands, or for none."""
    islands = plans.integers.shape[0]
    for i in range(islands):
        if repeats_chromosomes(unpack_plan(plans, i).method):
            return make_known_fitness(islands, n)
    return make_known_fitness(0, n)


@compile_borrowing
def _evolve_to_border(
    evaluator: Evaluator,
    plans: PackedPlans,
    packed: PackedIslands,
    known: KnownFitness,
    target: int,
    budget: int,
    log: EvolutionLog,
) -> int:
    """Evolve every island up to a border; return the remaining budget, −1 if it ran out."""
    for i in range(packed.champion_rms.size):
        begin, end = packed.offsets[i], packed.offsets[i + 1]
        plan, search, written = unpack_plan(plans, i), packed.search[i], log.counts[0]
        island = IslandArrays(
            packed.chromosomes[begin:end],
            packed.fitness[begin:end],
            search,
            packed.points[i],
            packed.archives[i],
            get_island_memory(known, i),
        )
        if search.generation >= target or is_island_resting(plan, island, packed.champion_rms[i]):
            continue
        if budget == 0:
            return -1
        before, rows = search.generation, log.improvements[written:]
        improvements = run_generations(evaluator, plan, min(target - before, budget), island, rows)
        _record_improvements(packed, i, improvements, log)
        budget -= search.generation - before
        if search.generation < target and not is_island_resting(
            plan, island, packed.champion_rms[i]
        ):
            return -1
    return budget


@jit_compile
def is_island_resting(plan: IslandPlan, island: IslandArrays, rms: float) -> bool:
    """Return whether an island has used up its evaluations or reached the target RMS.

    False before its population is evaluated, because the starts of a polynomial already count.
    """
    if np.all(np.isnan(island.fitness)):
        return False
    return is_done(plan, island.search, rms)


@compile_borrowing
def _record_improvements(
    packed: PackedIslands, island: int, improvements: int, log: EvolutionLog
) -> None:
    """Record the island of the improvements just written, and make the last one its champion."""
    for r in range(log.counts[0], log.counts[0] + improvements):
        log.improvement_islands[r] = island
    log.counts[0] += improvements
    if improvements:
        last = log.improvements[log.counts[0] - 1]
        packed.champion_rms[island] = last[COLUMN_RMS]
        for d in range(packed.champions.shape[1]):
            packed.champions[island, d] = last[COLUMN_VALUES + d]
