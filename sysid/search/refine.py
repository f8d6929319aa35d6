"""Refinement: bounded least squares from the champions of all islands."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import frexp, ldexp

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray
from sysid.search.archive import SAME_POINT
from sysid.search.least_squares import N_TRIED, ScoredSamples, solve_least_squares, steps_at_once
from sysid.simulation.evaluator import Evaluator, evaluate_population
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import AT_BOUND, from_unit, to_unit

_MAX_STEPS = 60
_LONG_RECORD = 2_000_000  # measured values times parameters: above, only two starts
_END_EVALUATIONS = 3  # simulations of a start and of an end, in addition to the steps


@dataclass(frozen=True, slots=True, eq=False)
class RefinedCandidate:
    """Result of the refinement of a start; `theta` is the start if there was no gain.

    `is_cut_short`: the deadline ended it, or prevented the refinement of the next start.
    """

    theta: FloatArray
    rms: float
    evaluations: int
    is_cut_short: bool = False


def refine_candidates(
    problem: Problem,
    starts: Sequence[FloatArray],
    evaluations: int | None = None,
    is_late: Callable[[], bool] | None = None,
) -> tuple[RefinedCandidate | None, ...]:
    """Refine each of the starts (D,), best first; None for a start that was skipped.

    Skipped are starts that diverge, that are near a better one, or that exceed the budget of
    `evaluations`. On long records only the two best are refined. `is_late` is called between
    compiled calls of about 0.1 s. The best start always gets one call.
    """
    values = problem.evaluate_fitness(np.array(starts))
    budget = 2**62 if evaluations is None else evaluations
    most_starts = (
        2
        if problem.evaluator.n_measured * len(problem.free_parameters) > _LONG_RECORD
        else len(starts)
    )
    candidates: list[RefinedCandidate | None] = [None] * len(starts)
    taken: list[FloatArray] = []
    last: tuple[int, RefinedCandidate] | None = None
    for i in np.argsort(values, kind="stable"):
        point = to_unit(problem.evaluator, np.array(starts[i])[None])[0]
        is_near_better = any(np.max(np.abs(point - other)) < SAME_POINT for other in taken)
        if is_near_better or len(taken) == most_starts or not np.isfinite(values[i]):
            continue
        if budget < point.size + N_TRIED + _END_EVALUATIONS:
            break
        if last is not None and is_late is not None and is_late():
            candidates[last[0]] = replace(last[1], is_cut_short=True)
            break
        taken.append(point)
        refined = _refine_point(problem, starts[i], point, float(values[i]), budget, is_late)
        candidates[i], budget, last = refined, budget - refined.evaluations, (i, refined)
    return tuple(candidates)


def refine_candidate(
    problem: Problem, start: FloatArray, rms: float, budget: int, steps: int = _MAX_STEPS
) -> RefinedCandidate | None:
    """Refine one start (D,) with its RMS; None if `budget` does not suffice for one step."""
    if budget < start.size + N_TRIED + _END_EVALUATIONS:
        return None
    point = to_unit(problem.evaluator, start[None])[0]
    return _refine_point(
        problem, start, point, rms, min(budget, steps * (start.size + N_TRIED) + _END_EVALUATIONS)
    )


def _refine_point(
    problem: Problem,
    start: FloatArray,
    point: FloatArray,
    rms: float,
    budget: int,
    is_late: Callable[[], bool] | None = None,
) -> RefinedCandidate:
    """Refine one start by least squares with at most `budget` simulations.

    Residuals are divided by about the scale of the outputs. So neither the tolerances of the search
    nor the limit of divergence depend on units. The divisor is a power of two: no rounding.
    """
    scale = max(problem.output_scale, rms)
    unit = ldexp(1.0, frexp(scale)[1]) if scale > 0 else 1.0
    evaluator, rows = problem.evaluator, problem.scored_rows
    steps = min(_MAX_STEPS, (budget - _END_EVALUATIONS) // (point.size + N_TRIED))
    at_once = steps_at_once(point.size, problem.n_steps)
    solved = solve_least_squares(
        ScoredSamples(evaluator, rows, evaluator.weight[rows] / unit),
        point,
        problem.loss_scale / unit,
        steps=steps,
        at_once=at_once,
        is_late=is_late,
    )
    theta, refined_rms = _snap_to_bounds(evaluator, solved.point)
    if refined_rms > rms:
        theta, refined_rms = start, rms
    return RefinedCandidate(
        np.array(theta), refined_rms, solved.evaluations + 2, solved.is_cut_short
    )


@jit_compile
def _snap_to_bounds(evaluator: Evaluator, point: FloatArray) -> tuple[FloatArray, float]:
    """Move a solution (D,) onto a bound that it approaches, if that is not worse."""
    points = np.empty((2, point.size))
    for d in range(point.size):
        points[1, d] = point[d]
        low, high = point[d] < AT_BOUND, point[d] > 1.0 - AT_BOUND
        points[0, d] = 0.0 if low else 1.0 if high else point[d]
    theta = from_unit(evaluator, points)
    values = evaluate_population(evaluator, theta)
    chosen = 0 if values[0] <= values[1] * (1.0 + 1e-9) else 1
    return theta[chosen], values[chosen]
