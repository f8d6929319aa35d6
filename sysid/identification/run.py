"""One run as a value that can continue from any cut: begin, advance, conclude.

The result does not depend on where a run is cut, nor on which process evolves which island.
Islands evolve alone up to the next *border*. Only there they exchange migrants, and the end
conditions are checked. The clock decides when to stop, never what is computed. It is read here and
nowhere else in this package.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from sysid.core.jit import read_clock
from sysid.core.settings import GeneticAlgorithm
from sysid.identification.free_run_starts import find_free_run_starts
from sysid.islands.archipelago import create_islands, make_plans
from sysid.islands.evolve import (
    compute_next_border,
    evolve_islands,
    get_border_interval,
    make_search_plan,
)
from sysid.islands.migration import migrate
from sysid.islands.run_state import RunState
from sysid.islands.stopping import has_search_ended, make_stopping_rule
from sysid.search.island import Island, evolve, get_island_settings
from sysid.selection.starts import find_equation_error_starts
from sysid.simulation.problem import Problem

__all__ = [
    "RunState",
    "advance_island",
    "advance_run",
    "begin_run",
    "exchange_migrants",
    "find_next_border",
    "is_finished",
]

CALL_SECONDS = 0.1
"""Target duration of one compiled call, so that a cancel takes effect in time."""

FIRST_CALL_STEPS = 4_000_000  # steps of integration or recursion in a first call: some 30 ms


def begin_run(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    seed: int,
    warm: Mapping[str, float] | Sequence[Mapping[str, float]] | None = None,
) -> RunState:
    """Create a run before its first generation; `warm` values seed a quarter of the population.

    The improved search of a polynomial is also seeded by one-step least squares, and that of a
    filter by free runs. Values of all free parameters count as an earlier result, after which a run
    settles sooner. Values of only some parameters just seed the search.
    """
    warm_starts = (warm,) if isinstance(warm, Mapping) else tuple(warm or ())
    warm_starts = tuple(values for values in warm_starts if values)
    is_warm = any(all(name in values for name in problem.free_names) for values in warm_starts)
    starts = (
        find_free_run_starts(problem, algorithm, seed)
        if problem.model.corrections
        else find_equation_error_starts(problem, algorithm)
    )
    islands = create_islands(
        problem, algorithm, seed, warm_starts, starts.values, starts.evaluations
    )
    for island in islands:
        island.search["is_warm_start"] = is_warm
    return RunState(seed, islands, is_warm=is_warm)


def find_next_border(algorithm: GeneticAlgorithm, state: RunState) -> int:
    """Compute the generation up to which every island evolves alone."""
    step = get_border_interval(algorithm, is_warm=state.is_warm)
    return compute_next_border(
        state.generation, step, algorithm.migration.every, algorithm.generations
    )


def advance_island(
    problem: Problem, algorithm: GeneticAlgorithm, island: Island, generations: int
) -> Island:
    """Evolve an island for some generations, fewer if it comes to rest."""
    plan = make_plans(problem, algorithm, island.seed)[island.index]
    return evolve(problem.evaluator, plan, island, generations)


def exchange_migrants(
    algorithm: GeneticAlgorithm, state: RunState, islands: Sequence[Island]
) -> RunState:
    """Exchange migrants at the next border, and check the end conditions."""
    generation = find_next_border(algorithm, state)
    state = replace(state, islands=tuple(islands), generation=generation)
    if generation % algorithm.migration.every == 0 and len(islands) > 1:
        bits = tuple(get_island_settings(algorithm, i).bits for i in range(len(islands)))
        moved, log = migrate(state.islands, bits, algorithm.migration, state.epoch)
        state = replace(
            state, islands=moved, migrations=state.migrations + log, epoch=state.epoch + 1
        )
    return replace(state, has_ended=_has_ended(algorithm, state))


def _has_ended(algorithm: GeneticAlgorithm, state: RunState) -> bool:
    is_old = state.is_warm and state.is_unimproved_since(state.generation // 2)
    ends = make_stopping_rule(algorithm, is_warm=state.is_warm)
    return has_search_ended(ends, state.generation, *state.champions_and_counters, is_old)


def is_finished(algorithm: GeneticAlgorithm, state: RunState) -> bool:
    """Whether an end condition holds: generations, evaluations, target RMS, settled, seconds."""
    limit = algorithm.stop.seconds
    return state.has_ended or (limit is not None and state.seconds >= limit)


def advance_run(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    state: RunState,
    seconds: float | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> RunState:
    """Continue until an end condition holds, `seconds` are used up, or `should_stop` is true.

    `should_stop` is called between compiled calls, about every 0.1 s.
    """
    plan = make_search_plan(problem, algorithm, state.seed, is_warm=state.is_warm)
    size = algorithm.population // algorithm.n_islands
    budget = _CallBudget(
        seconds,
        algorithm.stop.seconds,
        state.seconds,
        should_stop,
        FIRST_CALL_STEPS // (size * max(problem.n_steps, 1)),
    )
    while not is_finished(algorithm, state) and not budget.is_over():
        before, left = count_generations(state), algorithm.generations - state.generation
        archipelago = evolve_islands(
            problem.evaluator,
            plan,
            state.islands,
            state.generation,
            state.epoch,
            budget.count_affordable_generations(left * algorithm.n_islands),
        )
        state = replace(
            state,
            islands=archipelago.islands,
            generation=archipelago.generation,
            epoch=archipelago.epoch,
            migrations=state.migrations + archipelago.migrants,
        )
        budget.record_call(count_generations(state) - before)
        ended = archipelago.has_crossed and _has_ended(algorithm, state)
        state = replace(state, has_ended=ended, seconds=budget.measure_used_seconds())
    return state


def count_generations(state: RunState) -> int:
    """Count the generations of all islands together."""
    return sum(island.generation for island in state.islands)


class _CallBudget:
    """Generations per compiled call, and the time to stop, by the clock.

    `first` is the number of generations of the first call, before any measurement.
    """

    def __init__(
        self,
        seconds: float | None,
        limit: float | None,
        before: float,
        should_stop: Callable[[], bool] | None,
        first: int,
    ) -> None:
        self._start = self._last = read_clock()
        self._before, self._should_stop, self._calls = before, should_stop, 0
        ends = [
            end for end in (seconds, None if limit is None else limit - before) if end is not None
        ]
        self._end = min(ends, default=float("inf"))
        self._first_call_generations = first
        self._generation_seconds = 0.0  # of one generation of one island, as measured

    def measure_used_seconds(self) -> float:
        return self._before + read_clock() - self._start

    def is_over(self) -> bool:
        """Whether to stop; at least one call is always made, so every advance makes progress."""
        stopped = self._should_stop is not None and self._should_stop()
        return stopped or (self._calls > 0 and self._last - self._start >= self._end)

    def count_affordable_generations(self, wanted: int) -> int:
        """Count the generations of the next call: those left, or those the time allows.

        At least one, even if no time is left.
        """
        left = min(CALL_SECONDS, self._start + self._end - self._last)
        if left <= 0:
            return 1
        return max(
            1,
            min(
                wanted,
                int(left / self._generation_seconds)
                if self._calls
                else self._first_call_generations,
            ),
        )

    def record_call(self, count: int) -> None:
        now = read_clock()
        self._generation_seconds = max((now - self._last) / max(count, 1), 1e-9)
        self._last, self._calls = now, self._calls + 1
