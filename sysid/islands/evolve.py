"""All islands of a run evolved in one compiled call: generations, migration, a look at the end.

Between two calls nothing has to be decided, so a call may end anywhere: the result is that of
islands that evolve one after the other up to each border, and migrate there.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from sysid.core.jit import compiled
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray, IntArray
from sysid.islands.archipelago import shared_plans
from sysid.islands.migration import Routes, routes, send
from sysid.islands.packed import Fleet, News, dealt, empty_news, gathered, migrations
from sysid.islands.stopping import Ends, has_ended
from sysid.search.evolution import generations, is_done
from sysid.search.island import NEVER, Island
from sysid.search.state import RMS, VALUES, IslandArrays, Migrant, Plan
from sysid.simulation.evaluator import Evaluator
from sysid.simulation.problem import Problem, record_progress

_OFTEN = 5  # generations between two looks at the target RMS, or at a warm start
_BORDERS, _MIGRANTS = 100, 100_000
"""Borders that one call passes at most, and migrants that it has room for."""


_OWN = (
    "island", "first", "method", "bits", "survivors", "stagnation", "relative", "evaluations",
)  # fmt: skip


class Plans(NamedTuple):
    """The plans of all islands; `own` and `floats` have what differs.

    See `sysid.search.state.Plan`.

    Attributes
    ----------
    seed, total : int
    loss_scale : float
    progress : FloatArray, shape (M,)
    own : IntArray, shape (I, 8)
        Those of `_OWN`.
    floats : FloatArray, shape (I, 2)
        beta, rms.
    starts, rates : arrays, shape (I, S)
        Shorter mutation schedules end with their last entry repeated.
    """

    seed: int
    total: int
    loss_scale: float
    progress: FloatArray
    own: IntArray
    floats: FloatArray
    starts: IntArray
    rates: FloatArray


class Course(NamedTuple):
    """What the islands of a run do, up to its end.

    Attributes
    ----------
    step, every : int
        Generations from border to border at most, and from one migration to the next.
    borders : int
        After so many borders a call ends.
    """

    plans: Plans
    routes: Routes
    ends: Ends
    step: int
    every: int
    borders: int


class Stand(NamedTuple):
    """Where a run stands after a call; `has_crossed`: at a border that it has just passed."""

    islands: tuple[Island, ...]
    migrants: tuple[Migrant, ...]
    generation: int
    epoch: int
    has_crossed: bool


def course(problem: Problem, algorithm: GeneticAlgorithm, seed: int, *, is_warm: bool) -> Course:
    """The course of a run; `is_warm`: an earlier result stands behind it."""
    way = _course(algorithm, len(problem.space), problem.loss_scale, is_warm)
    own = way.plans._replace(seed=seed, progress=record_progress(problem))
    return way._replace(plans=own)


def ends_of(algorithm: GeneticAlgorithm, *, is_warm: bool) -> Ends:
    """When a run ends."""
    stop = algorithm.stop
    target = NEVER if stop.rms is None else float(stop.rms)
    return Ends(algorithm.generations, target, stop.settled or 0, is_warm)


def step_of(algorithm: GeneticAlgorithm, *, is_warm: bool) -> int:
    """Generations from one border to the next at most."""
    looks_often = algorithm.stop.rms is not None or is_warm
    return min(algorithm.migration.every, _OFTEN) if looks_often else algorithm.migration.every


@lru_cache(maxsize=64)
def _course(algorithm: GeneticAlgorithm, n: int, scale: float, is_warm: bool) -> Course:
    """What the courses of all runs of n parameters share; its arrays are not to be written to."""
    planned = shared_plans(algorithm, n, scale)
    longest = max(plan.starts.size for plan in planned)
    plans = Plans(
        0, algorithm.population, scale, np.zeros(0),
        np.array([[getattr(plan, name) for name in _OWN] for plan in planned], dtype=np.int64),
        np.array([(plan.beta, plan.rms) for plan in planned]),
        np.array([_filled(plan.starts, longest) for plan in planned]),
        np.array([_filled(plan.rates, longest) for plan in planned]),
    )  # fmt: skip
    ways = routes([plan.bits for plan in planned], algorithm.migration, algorithm.population)
    room = _MIGRANTS // max(1, len(ways.edges) * ways.migrants)
    borders = 1 if is_warm else max(1, min(_BORDERS, room))  # a warm one's history is looked at
    return Course(
        plans, ways, ends_of(algorithm, is_warm=is_warm), step_of(algorithm, is_warm=is_warm),
        algorithm.migration.every, borders,
    )  # fmt: skip


def evolve_all(
    evaluator: Evaluator, way: Course, islands: Sequence[Island], generation: int, epoch: int,
    budget: int,
) -> Stand:  # fmt: skip
    """The islands of a run after at most `budget` generations of all of them together.

    Parameters
    ----------
    generation, epoch : int
        The last border, and migrations until then.
    """
    fleet, edges = gathered(islands), len(way.routes.edges)
    news = empty_news(
        budget + way.borders * (len(islands) + edges), way.borders * edges * way.routes.migrants,
        fleet.champions.shape[1],
    )  # fmt: skip
    at, epoch, has_crossed = _sail(evaluator, way, fleet, generation, epoch, budget, news)
    return Stand(dealt(fleet, news, islands), migrations(news), at, epoch, has_crossed)


def _filled(values: IntArray | FloatArray, size: int) -> IntArray | FloatArray:
    return np.concatenate([values, np.repeat(values[-1:], size - values.size)])


@compiled
def plan_of(plans: Plans, i: int) -> Plan:
    """The plan of one island."""
    own, floats = plans.own[i], plans.floats[i]
    return Plan(
        plans.seed, own[0], own[1], plans.total, own[2], own[3], own[4], own[5], own[6], own[7],
        floats[0], floats[1], plans.loss_scale, plans.starts[i], plans.rates[i], plans.progress,
    )  # fmt: skip


@compiled
def next_border(generation: int, step: int, every: int, generations_: int) -> int:
    """The generation up to which all islands evolve alone."""
    return min(generation + min(step, every - generation % every), generations_)


@compiled
def _sail(
    evaluator: Evaluator, way: Course, fleet: Fleet, generation: int, epoch: int, budget: int,
    news: News,
) -> tuple[int, int, bool]:  # fmt: skip
    """Go on in place; gives the last border, the migrations and whether it was passed just now."""
    for _ in range(way.borders):
        target = next_border(generation, way.step, way.every, way.ends.generations)
        budget = _to_border(evaluator, way.plans, fleet, target, budget, news)
        if budget < 0:
            return generation, epoch, False
        generation = target
        if generation % way.every == 0 and fleet.rms.size > 1:
            send(way.routes, fleet, epoch, news)
            epoch += 1
        if has_ended(way.ends, generation, fleet.rms, fleet.search, False):
            break
    return generation, epoch, True


@compiled
def _to_border(
    evaluator: Evaluator, plans: Plans, fleet: Fleet, target: int, budget: int, news: News
) -> int:
    """Evolve every island up to a border; gives what is left of the budget, −1 if too little."""
    for i in range(fleet.rms.size):
        begin, end = fleet.first[i], fleet.first[i + 1]
        plan, search, written = plan_of(plans, i), fleet.search[i], news.written[0]
        island = IslandArrays(
            fleet.words[begin:end], fleet.fitness[begin:end], search, fleet.points[i]
        )
        if search.generation >= target or rests(plan, island, fleet.rms[i]):
            continue
        if budget == 0:
            return -1
        before, rows = search.generation, news.improvements[written:]
        made = generations(evaluator, plan, min(target - before, budget), island, rows)
        _take_note(fleet, i, made, news)
        budget -= search.generation - before
        if search.generation < target and not rests(plan, island, fleet.rms[i]):
            return -1
    return budget


@compiled
def rests(plan: Plan, island: IslandArrays, rms: float) -> bool:
    """Whether an island has used up its evaluations or reached the target RMS.

    Not before its population is evaluated: finding the starts of a polynomial counts, too.
    """
    if np.all(np.isnan(island.fitness)):
        return False
    return is_done(plan, island.search, rms)


@compiled
def _take_note(fleet: Fleet, island: int, made: int, news: News) -> None:
    """Whose the improvements just written are, and the champion that the last one is."""
    for r in range(news.written[0], news.written[0] + made):
        news.owners[r] = island
    news.written[0] += made
    if made:
        last = news.improvements[news.written[0] - 1]
        fleet.rms[island] = last[RMS]
        for d in range(fleet.champions.shape[1]):
            fleet.champions[island, d] = last[VALUES + d]
