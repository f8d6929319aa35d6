"""Refinement: bounded least squares from the champions of all islands."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.ga.chromosome import located, placed
from sysid.islands.archipelago import loss_scale
from sysid.kernels.caching import compiled
from sysid.kernels.evaluation import partial_predictions
from sysid.kernels.evaluator import Evaluator
from sysid.least_squares import TRIED, Loss, solve
from sysid.problem import Problem
from sysid.pulls import AT_BOUND
from sysid.types import FloatArray, IntArray

_SAME = 1e-3  # of the range: nearer champions lie in one valley
_DIFFERENCE = 1e-6  # of the range
_STEPS = 60
_LONG = 2_000_000  # measured values times parameters: from here on, few starts and steps
_ENDS = 3  # simulations of a start and of an end, besides the steps


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A start and what least squares made of it; `theta` is the start if it gained nothing."""

    theta: FloatArray
    rms: float
    evaluations: int


def refine(
    problem: Problem, starts: Sequence[FloatArray], evaluations: int | None = None
) -> tuple[Refined | None, ...]:
    """Refine each of the starts (D,), best first; None for one that was left out.

    Left out are starts that diverge, that lie beside a better one, or for which nothing of the
    budget of `evaluations` is left. On long records only the two best are refined.
    """
    values = problem.fitness(np.array(starts))
    left = 2**62 if evaluations is None else evaluations
    most = 2 if problem.evaluator.n_measured * len(problem.space) > _LONG else len(starts)
    found: list[Refined | None] = [None] * len(starts)
    taken: list[FloatArray] = []
    for i in np.argsort(values, kind="stable"):
        place = placed(problem.evaluator, np.array(starts[i])[None])[0]
        beside = any(np.max(np.abs(place - other)) < _SAME for other in taken)
        if beside or len(taken) == most or not np.isfinite(values[i]):
            continue
        if left < place.size + TRIED + _ENDS:
            break
        taken.append(place)
        refined = _refined(problem, starts[i], place, float(values[i]), left)
        found[i], left = refined, left - refined.evaluations
    return tuple(found)


def refine_one(
    problem: Problem, start: FloatArray, rms: float, left: int, steps: int = _STEPS
) -> Refined | None:
    """Least squares from one start (D,) of known RMS; None if fewer than a step is `left`."""
    if left < start.size + TRIED + _ENDS:
        return None
    place = placed(problem.evaluator, start[None])[0]
    return _refined(problem, start, place, rms, min(left, steps * (start.size + TRIED) + _ENDS))


def _refined(
    problem: Problem, start: FloatArray, place: FloatArray, rms: float, left: int
) -> Refined:
    """Least squares from one start; the search may use `left` simulations."""
    search = _LeastSquares(problem, max(problem.output_scale, rms))
    steps = min(_STEPS, (left - _ENDS) // (place.size + TRIED))
    loss = Loss(loss_scale(problem) / search.unit)
    solved = solve(search.residuals, search.jacobian, place, loss, steps=steps)
    theta, reached = search.best(solved.place)
    if reached > rms:
        theta, reached = start, rms
    return Refined(np.array(theta), reached, search.evaluations)


@compiled
def _residuals(
    evaluator: Evaluator, places: FloatArray, scored: IntArray, weight: FloatArray
) -> FloatArray:
    """Weighted residuals (P, n) of the scored values at places (P, D)."""
    predicted = partial_predictions(evaluator, located(evaluator, places), 1.0)
    errors = np.empty((places.shape[0], scored.size))
    for i in range(scored.size):
        for p in range(places.shape[0]):
            errors[p, i] = weight[i] * (predicted[scored[i], p] - evaluator.measured[scored[i]])
    return errors


@compiled
def _slopes(
    evaluator: Evaluator, place: FloatArray, error: FloatArray, scored: IntArray, weight: FloatArray
) -> FloatArray:
    """Slopes (n, D) of the residuals (n,) at a place (D,); 0 where a neighbour diverges."""
    places, steps = np.empty((place.size, place.size)), np.empty(place.size)
    for d in range(place.size):
        steps[d] = _DIFFERENCE if place[d] < 0.5 else -_DIFFERENCE
        for k in range(place.size):
            places[d, k] = place[k] + (steps[d] if k == d else 0.0)
    predicted = partial_predictions(evaluator, located(evaluator, places), 1.0)
    slopes = np.empty((scored.size, place.size))
    for i in range(scored.size):
        for d in range(place.size):
            there = weight[i] * (predicted[scored[i], d] - evaluator.measured[scored[i]])
            slope = (there - error[i]) / steps[d]
            slopes[i, d] = slope if np.isfinite(slope) else 0.0
    return slopes


class _LeastSquares:
    """Residuals and Jacobian over places in [0, 1], counting simulations.

    Residuals are in units of about the outputs' `scale`, so that the tolerances of the search and
    what counts as diverged do not depend on the outputs' unit. It is a power of two: no rounding.
    """

    def __init__(self, problem: Problem, scale: float) -> None:
        self.problem, self.evaluations = problem, 0
        self.unit = float(np.ldexp(1.0, int(np.frexp(scale)[1]))) if scale > 0 else 1.0
        evaluator = problem.evaluator
        self._scored = np.flatnonzero(evaluator.weight > 0)
        self._weight = evaluator.weight[self._scored] / self.unit

    def residuals(self, places: FloatArray) -> FloatArray:
        """Weighted residuals (P, n) of places (P, D), in one batch."""
        self.evaluations += places.shape[0]
        evaluator = self.problem.evaluator
        return _residuals(evaluator, np.ascontiguousarray(places), self._scored, self._weight)

    def jacobian(self, place: FloatArray, error: FloatArray) -> FloatArray:
        """Forward differences away from the nearer bound, one batch of D simulations."""
        self.evaluations += place.size
        return _slopes(self.problem.evaluator, place, error, self._scored, self._weight)

    def best(self, place: FloatArray) -> tuple[FloatArray, float]:
        """The solution, moved onto a bound that it only approaches if that is not worse."""
        snapped = np.where(place < AT_BOUND, 0.0, np.where(place > 1 - AT_BOUND, 1.0, place))
        theta = located(self.problem.evaluator, np.vstack([snapped, place]))
        values = self.problem.fitness(theta)
        self.evaluations += 2
        chosen = 0 if values[0] <= values[1] * (1 + 1e-9) else 1
        return theta[chosen], float(values[chosen])
