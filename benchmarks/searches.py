"""Run one search of lagid and compare it with the least-squares optimum of its record."""

import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from benchmarks.systems import System
from sysid.core.settings import GeneticAlgorithm, SearchMethod, Stop
from sysid.core.types import FloatArray
from sysid.identification.conclude import conclude_run
from sysid.identification.run import advance_run, begin_run
from sysid.islands.run_state import RunState
from sysid.search.state import Improvement
from sysid.simulation.problem import Problem

BUDGET = 20_000
NEAR = 1e-4
"""Largest relative distance to the least-squares optimum that counts as having reached it."""

TARGET = 1.01
"""Of the optimum's RMS: the target of `bench/peers`, at which evaluations and time are taken."""

# What the peers' table calls found in noise-free data: the errors of the paper's Tables 1 and 2.
TOLERANCES = {
    "A": {"c": 0.0049, "L": 0.0024, "b": 0.0049, "a": 0.0127},
    "B": {"c": 0.0154, "L": 0.0171, "b": 0.0440, "mu": 0.0200},
}


@dataclass(frozen=True)
class Goal:
    """The optimum's RMS, and what an individual has to satisfy to be a hit."""

    optimum: float
    level: float
    names: tuple[str, ...]
    truth: FloatArray
    tolerances: FloatArray | None

    @property
    def rms(self) -> float:
        """RMS at which the target is hit."""
        return TARGET * self.optimum

    def distance(self, rms: float) -> float:
        """Distance of a result to the optimum, relative to its RMS (to the output's, if 0)."""
        scale = self.level if self.tolerances is not None else self.optimum
        return (rms - self.optimum) / scale

    def hit(self, rms: float, parameters: FloatArray) -> bool:
        """Whether an individual is at the target."""
        if self.tolerances is None:
            return rms <= self.rms
        return bool(np.all(np.abs(parameters - self.truth) < self.tolerances))


@dataclass(frozen=True)
class Search:
    """What one search gave: distance to the optimum, cost to the target, cost of the whole.

    `to_target` counts all islands up to the generation in which the first of them is there;
    `in_order` what one process simulates until then, which evolves the islands one after the
    other from migration to migration. `seconds` are those of the search, `after` those of the
    refinement, the standard errors and the tests of the residuals that follow it.
    """

    distance: float
    evaluations: int
    to_target: int | None
    in_order: int | None
    seconds_to_target: float
    prorated: float
    seconds: float
    after: float
    is_settled: bool


def optimum(problem: Problem, starts: list[FloatArray]) -> float:
    """Least RMS that SciPy's bounded least squares reaches from the given values."""
    lower = np.array([p.lower for p in problem.free_parameters])
    upper = np.array([p.upper for p in problem.free_parameters])
    weight, measured = problem.evaluator.weight, problem.evaluator.measured

    def residuals(unit: FloatArray) -> FloatArray:
        theta = np.clip(lower + (upper - lower) * unit, lower, upper)
        error = weight * (problem.predict(theta[None])[0] - measured)
        return np.nan_to_num(np.clip(error, -1e6, 1e6), nan=1e6)

    least = np.inf
    for start in starts:
        place = np.clip((start - lower) / (upper - lower), 0.0, 1.0)
        for step in (1e-7, 1e-5):
            solved = least_squares(
                residuals,
                place,
                bounds=(0.0, 1.0),
                diff_step=step,
                x_scale="jac",
                ftol=1e-14,
                xtol=1e-14,
                gtol=1e-15,
                max_nfev=200,
            )
            theta = np.clip(lower + (upper - lower) * np.vstack([place, solved.x]), lower, upper)
            least = min(least, float(np.min(problem.evaluate_fitness(theta))))
    return least


def build_goal(system: System, problem: Problem, result: FloatArray | None = None) -> Goal:
    """The goal on a record, from least squares from the truth and from what was found."""
    truth = system.place(problem)
    names = problem.free_names
    tolerances = None
    if system.noise == 0:
        tolerances = np.array([TOLERANCES[system.name[0]][name] for name in names])
    starts = [truth] if result is None else [truth, result]
    best = 0.0 if system.noise == 0 else optimum(problem, starts)
    return Goal(best, system.level, names, truth, tolerances)


def search(system: System, seed: int, method: SearchMethod = "improved") -> tuple[Search, Goal]:
    """Run one search with its own noise draw and seed, and judge it."""
    problem = system.problem(seed)
    algorithm = GeneticAlgorithm(method=method, stop=Stop(evaluations=BUDGET))
    start = time.process_time()
    state = advance_run(problem, algorithm, begin_run(problem, algorithm, seed))
    searched = time.process_time()
    result = conclude_run(problem, algorithm, state)
    seconds, after = searched - start, time.process_time() - searched
    values = {estimate.name: estimate.value for estimate in result.parameters}
    best = np.array([values[name] for name in problem.free_names])
    goal = build_goal(system, problem, best)
    generation = _hit(state, goal)
    if generation is None:
        hit, took = None, np.nan
        if result.rms <= goal.rms and goal.tolerances is None:  # by the refinement alone
            hit, took = result.evaluations, seconds + after
        in_order = hit
    else:
        replayed, took = _replay(problem, algorithm, seed, generation)
        hit, in_order = replayed.evaluations, _in_order(problem, algorithm, seed, state, goal)
    share = np.nan if hit is None else seconds * hit / state.evaluations
    settled = state.generation < algorithm.generations and all(
        island.generation == state.generation for island in state.islands
    )
    outcome = Search(
        goal.distance(result.rms),
        result.evaluations,
        hit,
        in_order,
        took,
        share,
        seconds,
        after,
        settled,
    )
    return outcome, goal


def _hit(state: RunState, goal: Goal) -> int | None:
    """First generation in which an island is at the target."""
    return min((step.generation for _, step in _hits(state, goal)), default=None)


def _hits(state: RunState, goal: Goal) -> list[tuple[int, Improvement]]:
    """Islands that got to the target, in their order, and the step by which each did."""
    firsts = [
        (i, next((step for step in island.history if _is_hit(step, goal)), None))
        for i, island in enumerate(state.islands)
    ]
    return [(i, step) for i, step in firsts if step is not None]


def _in_order(
    problem: Problem, algorithm: GeneticAlgorithm, seed: int, state: RunState, goal: Goal
) -> int:
    """Simulations of one process up to the target, as the counter of an optimiser gives them."""
    hits, every = _hits(state, goal), algorithm.migration.every
    begin_ = max(min(step.generation for _, step in hits) - 1, 0) // every * every
    island, step = next(hit for hit in hits if hit[1].generation <= begin_ + every)
    ended = _replay(problem, algorithm, seed, begin_ + every)[0].islands[:island]
    waiting = _replay(problem, algorithm, seed, begin_)[0].islands[island + 1 :] if begin_ else ()
    return step.evaluations + sum(island.evaluations for island in (*ended, *waiting))


def _is_hit(step: Improvement, goal: Goal) -> bool:
    return goal.hit(step.rms, np.array(step.parameters))


def _replay(
    problem: Problem, algorithm: GeneticAlgorithm, seed: int, generation: int
) -> tuple[RunState, float]:
    """All islands at a generation of the same search, and the CPU seconds up to there."""
    shorter = replace(algorithm, generations=max(generation, 1), refine=algorithm.refine)
    start = time.process_time()
    state = advance_run(problem, shorter, begin_run(problem, shorter, seed))
    return state, time.process_time() - start
