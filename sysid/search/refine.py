"""Refinement: bounded least squares from the champions of all islands."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray
from sysid.search.least_squares import N_TRIED, ScoredSamples, solve_least_squares, steps_at_once
from sysid.simulation.evaluator import Evaluator, evaluate_population
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import AT_BOUND, from_unit, to_unit

_SAME_VALLEY = 1e-3  # of the range: nearer champions lie in one valley
_MOST_STEPS = 60
_LONG_RECORD = 2_000_000  # measured values times parameters: from here on, few starts and steps
_END_EVALUATIONS = 3  # simulations of a start and of an end, besides the steps


@dataclass(frozen=True, slots=True, eq=False)
class RefinedCandidate:
    """A start and what least squares made of it; `theta` is the start if it gained nothing.

    `is_cut_short`: it was too late to go on to its end, or to begin with the start after it.
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
    """Refine each of the starts (D,), best first; None for one that was left out.

    Left out are starts that diverge, that lie beside a better one, or for which nothing of the
    budget of `evaluations` is left. On long records only the two best are refined. `is_late` is
    asked between compiled calls of about 0.1 s; of the best start there is one call always.
    """
    values = problem.evaluate_fitness(np.array(starts))
    left = 2**62 if evaluations is None else evaluations
    most = (
        2
        if problem.evaluator.n_measured * len(problem.free_parameters) > _LONG_RECORD
        else len(starts)
    )
    found: list[RefinedCandidate | None] = [None] * len(starts)
    taken: list[FloatArray] = []
    before: tuple[int, RefinedCandidate] | None = None
    for i in np.argsort(values, kind="stable"):
        place = to_unit(problem.evaluator, np.array(starts[i])[None])[0]
        beside = any(np.max(np.abs(place - other)) < _SAME_VALLEY for other in taken)
        if beside or len(taken) == most or not np.isfinite(values[i]):
            continue
        if left < place.size + N_TRIED + _END_EVALUATIONS:
            break
        if before is not None and is_late is not None and is_late():
            found[before[0]] = replace(before[1], is_cut_short=True)
            break
        taken.append(place)
        refined = _refine_place(problem, starts[i], place, float(values[i]), left, is_late)
        found[i], left, before = refined, left - refined.evaluations, (i, refined)
    return tuple(found)


def refine_candidate(
    problem: Problem, start: FloatArray, rms: float, left: int, steps: int = _MOST_STEPS
) -> RefinedCandidate | None:
    """Least squares from one start (D,) of known RMS; None if fewer than a step is `left`."""
    if left < start.size + N_TRIED + _END_EVALUATIONS:
        return None
    place = to_unit(problem.evaluator, start[None])[0]
    return _refine_place(
        problem, start, place, rms, min(left, steps * (start.size + N_TRIED) + _END_EVALUATIONS)
    )


def _refine_place(
    problem: Problem,
    start: FloatArray,
    place: FloatArray,
    rms: float,
    left: int,
    is_late: Callable[[], bool] | None = None,
) -> RefinedCandidate:
    """Least squares from one start; the search may use `left` simulations.

    Residuals are in units of about the outputs' scale, so that the tolerances of the search and
    what counts as diverged do not depend on the outputs' unit. It is a power of two: no rounding.
    """
    size = max(problem.output_scale, rms)
    unit = float(np.ldexp(1.0, int(np.frexp(size)[1]))) if size > 0 else 1.0
    evaluator, rows = problem.evaluator, problem.scored_rows
    steps = min(_MOST_STEPS, (left - _END_EVALUATIONS) // (place.size + N_TRIED))
    at_once = steps_at_once(place.size, problem.n_steps)
    solved = solve_least_squares(
        ScoredSamples(evaluator, rows, evaluator.weight[rows] / unit),
        place,
        problem.loss_scale / unit,
        steps=steps,
        at_once=at_once,
        is_late=is_late,
    )
    theta, reached = _snap_to_bounds(evaluator, solved.place)
    if reached > rms:
        theta, reached = start, rms
    return RefinedCandidate(np.array(theta), reached, solved.evaluations + 2, solved.is_cut_short)


@jit_compile
def _snap_to_bounds(evaluator: Evaluator, place: FloatArray) -> tuple[FloatArray, float]:
    """A solution (D,), moved onto a bound that it only approaches if that is not worse."""
    places = np.empty((2, place.size))
    for d in range(place.size):
        places[1, d] = place[d]
        low, high = place[d] < AT_BOUND, place[d] > 1.0 - AT_BOUND
        places[0, d] = 0.0 if low else 1.0 if high else place[d]
    theta = from_unit(evaluator, places)
    values = evaluate_population(evaluator, theta)
    chosen = 0 if values[0] <= values[1] * (1.0 + 1e-9) else 1
    return theta[chosen], values[chosen]
