"""One run as a value that goes on from wherever it was cut: begin, advance, conclude.

The result does not depend on where a run is cut, nor on which process evolves which island:
islands evolve alone up to the next *border*, and only there do they exchange migrants and is it
decided whether the run has ended. The clock decides when to stop, never what is computed; it is
read here and nowhere else in this package.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np

from sysid.conclusion import conclude
from sysid.ga.island import Island, evolve
from sysid.ga.state import WARMED, Plan
from sysid.islands.archipelago import found, of_island, plans
from sysid.islands.migration import migrate
from sysid.islands.run_state import RunState
from sysid.problem import Problem
from sysid.selection import equation_error_starts
from sysid.settings import GeneticAlgorithm

__all__ = [
    "RunState", "advance", "advance_island", "begin", "border", "conclude", "exchange",
    "is_finished", "is_resting",
]  # fmt: skip

CALL_SECONDS = 0.1
"""Aimed at for one compiled call, by measured cost, so that a cancel is heard in time."""

_TARGET_ROUND = 5  # generations between two looks at the target RMS, or at a warm start
_OF_EACH, _MORE = 2, 2
_SHARE = 1 / 3  # of all searches
_HALF, _MANY = 0.5, 2.5  # of those from random places agree, or there are so many times enough
_AGREE = 2 / 3  # of the searches from random places, where the fitness jumps
_RETURN = 0.9  # of those from beside the best individual
_WARM_SETTLED = 3  # of the searches that agree, a warm start needs one in three


def begin(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    seed: int,
    warm: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
) -> RunState:
    """A run before its first generation; `warm`: parameter values that seed a quarter of it.

    The improved search of a polynomial is seeded by least squares one step ahead, too. Values of
    all free parameters are taken for an earlier result, behind which a run settles sooner; those
    of some of them seed the search, and no more.
    """
    given = (warm,) if isinstance(warm, Mapping) else tuple(warm or ())
    given = tuple(one for one in given if one)
    is_warm = any(all(p.name in one for p in problem.space) for one in given)
    starts = equation_error_starts(problem, algorithm)
    islands = found(problem, algorithm, seed, given, starts.values, starts.evaluations)
    for island in islands:
        island.counters[WARMED] = is_warm
    return RunState(seed, islands, is_warm=is_warm)


def border(algorithm: GeneticAlgorithm, state: RunState) -> int:
    """The generation up to which every island evolves alone."""
    every = algorithm.migration.every
    looks_often = algorithm.stop.rms is not None or state.is_warm
    step = min(every, _TARGET_ROUND) if looks_often else every
    at, done = state.generation, state.generation % every
    return min(at + min(step, every - done), algorithm.generations)


def is_resting(plan: Plan, island: Island) -> bool:
    """Whether an island has used up its evaluations or reached the target RMS.

    Not before its population is evaluated: finding the starts of a polynomial counts, too.
    """
    if np.isnan(island.fitness).all():
        return False
    return island.evaluations >= plan.evaluations or island.champion_rms <= plan.rms


def advance_island(
    problem: Problem, algorithm: GeneticAlgorithm, island: Island, generations: int
) -> Island:
    """The island after some generations, fewer where it comes to rest."""
    plan = plans(problem, algorithm, island.seed)[island.index]
    return evolve(problem.evaluator, plan, island, generations)


def exchange(algorithm: GeneticAlgorithm, state: RunState, islands: Sequence[Island]) -> RunState:
    """The run at the next border, when all its islands have got there: migrate, look at the end."""
    generation = border(algorithm, state)
    state = replace(state, islands=tuple(islands), generation=generation)
    if generation % algorithm.migration.every == 0 and len(islands) > 1:
        bits = tuple(of_island(algorithm, i).bits for i in range(len(islands)))
        moved, log = migrate(state.islands, bits, algorithm.migration, state.epoch)
        state = replace(
            state, islands=moved, migrations=state.migrations + log, epoch=state.epoch + 1
        )
    return replace(state, ended=_has_ended(algorithm, state))


def _has_ended(algorithm: GeneticAlgorithm, state: RunState) -> bool:
    if state.generation >= algorithm.generations:
        return True
    if algorithm.stop.rms is not None and state.rms <= algorithm.stop.rms:
        return True
    if algorithm.stop.settled is not None and _is_settled(algorithm.stop.settled, state):
        return True
    # Below the border only those islands stay that have used up their evaluations.
    return all(island.generation < state.generation for island in state.islands)


def _is_settled(settled: int, state: RunState) -> bool:
    """Whether searches keep finding the best individual, from random places and from beside it.

    Had a better one as many ways that lead to it, all of k searches that found the best again and
    those that found others would have missed it with a probability below exp(-k). So where the
    fitness around is smooth, those that led to worse ones say nothing against the best, unless
    they are the most. Where it jumps, a better one nearby may draw few searches beside a wide one
    that draws many: then nearly all must agree.
    But what was found from beside the best says little of minima far away. So where fewer than
    half of those from random places agree, these must be many: at 5 of 14 one search in a hundred
    ended at twice the least RMS.
    Behind a warm start stands an earlier result. So a third of them is enough, and so it is that
    as many from random places, one from beside it (where the fitness jumps, as many) and the
    second half of the generations have found nothing better. Those from beside it alone would not
    do: around a false optimum they find nothing better.
    """
    hops, returned = state.hops
    if state.is_warm:
        tried = state.independent >= settled and hops >= (settled if state.has_cliffs else 1)
        if tried and state.is_the_best_since(state.generation // 2):
            return True
        settled = -(-settled // _WARM_SETTLED)
    if state.has_cliffs:
        every = returned >= max(settled, _RETURN * hops)
        return every and state.confirmed >= max(settled, _AGREE * state.independent)
    again, enough = state.confirmed + returned, settled + _MORE
    if min(state.confirmed, returned) < -(-settled // _OF_EACH):
        return False
    agree = state.confirmed >= max(enough, _HALF * state.independent)
    if not (state.is_warm or agree or state.independent >= _MANY * enough):
        return False
    return again >= max(enough, _SHARE * (state.independent + hops))


def is_finished(algorithm: GeneticAlgorithm, state: RunState) -> bool:
    """Whether an end condition holds: generations, evaluations, target RMS, settled, seconds."""
    limit = algorithm.stop.seconds
    return state.ended or (limit is not None and state.seconds >= limit)


def advance(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    seconds: float | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> RunState:
    """Go on until an end condition holds, `seconds` are used up, or `should_stop` says so.

    `should_stop` is asked between compiled calls, about every 0.1 s.
    """
    pace = _Pace(seconds, algorithm.stop.seconds, state.seconds, should_stop)
    planned = plans(problem, algorithm, state.seed)
    while not is_finished(algorithm, state):
        target = border(algorithm, state)
        islands = list(state.islands)
        for i, plan in enumerate(planned):
            while islands[i].generation < target and not is_resting(plan, islands[i]):
                if pace.is_over():
                    return replace(state, islands=tuple(islands), seconds=pace.used())
                count = pace.affordable(target - islands[i].generation)
                islands[i] = evolve(problem.evaluator, plan, islands[i], count)
                pace.measure(count)
        state = replace(exchange(algorithm, state, islands), seconds=pace.used())
    return state


class _Pace:
    """How many generations one compiled call may run, and when to stop, by the clock."""

    def __init__(
        self,
        seconds: float | None,
        limit: float | None,
        before: float,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        self._start = self._last = perf_counter()
        self._before, self._should_stop, self._calls = before, should_stop, 0
        ends = [
            end for end in (seconds, None if limit is None else limit - before) if end is not None
        ]
        self._end = min(ends, default=float("inf"))
        self._cost = CALL_SECONDS  # of one generation, until it is measured

    def used(self) -> float:
        return self._before + perf_counter() - self._start

    def is_over(self) -> bool:
        """Whether to stop; at least one call is made, so that every advance advances."""
        stopped = self._should_stop is not None and self._should_stop()
        return stopped or (self._calls > 0 and self._last - self._start >= self._end)

    def affordable(self, wanted: int) -> int:
        return max(1, min(wanted, int(CALL_SECONDS / self._cost)))

    def measure(self, count: int) -> None:
        now = perf_counter()
        self._cost = max((now - self._last) / count, 1e-9)
        self._last, self._calls = now, self._calls + 1
