"""Refinement: bounded least squares from the champions of all islands."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from sysid.ga.chromosome import located, placed
from sysid.islands.archipelago import loss_scale
from sysid.problem import Problem
from sysid.types import FloatArray

_SAME = 1e-3  # of the range: nearer champions lie in one valley
_DIFFERENCE = 1e-6  # of the range
_STEPS = 60
_LONG = 2_000_000  # measured values times parameters: from here on, few starts and steps
_AT_BOUND = 1e-6
# Residual of a diverged simulation, in units of the outputs: finite, so that a smaller step is
# tried.
_REJECTED = 1e10


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
        if left < 2 * (place.size + 2):
            break
        taken.append(place)
        refined = _refined(problem, starts[i], place, float(values[i]), left)
        found[i], left = refined, left - refined.evaluations
    return tuple(found)


def _refined(
    problem: Problem, start: FloatArray, place: FloatArray, rms: float, left: int
) -> Refined:
    """Least squares from one start; the search may use `left` simulations."""
    search = _LeastSquares(problem, max(problem.output_scale, rms))
    steps = min(_STEPS, left // (place.size + 2))
    scale = loss_scale(problem) / search.unit
    solved = least_squares(
        search.residuals, place, search.jacobian, bounds=(0.0, 1.0), method="trf",
        loss="soft_l1" if scale > 0 else "linear", f_scale=scale or 1.0,
        xtol=1e-12, ftol=1e-13, gtol=1e-14, max_nfev=steps,
    )  # fmt: skip
    theta, reached = search.best(solved.x)
    if reached > rms:
        theta, reached = start, rms
    return Refined(np.array(theta), reached, search.evaluations)


class _LeastSquares:
    """Residuals and Jacobian over places in [0, 1], counting simulations.

    Residuals are in units of about the outputs' `scale`, so that the tolerances of the search and
    what counts as diverged do not depend on the outputs' unit. It is a power of two: no rounding.
    """

    def __init__(self, problem: Problem, scale: float) -> None:
        self.problem, self.evaluations = problem, 0
        self.unit = float(np.ldexp(1.0, int(np.frexp(scale)[1]))) if scale > 0 else 1.0
        self._scored = problem.evaluator.weight > 0

    def _predictions(self, places: FloatArray) -> FloatArray:
        self.evaluations += places.shape[0]
        theta = located(self.problem.evaluator, np.ascontiguousarray(places))
        weight = self.problem.evaluator.weight[self._scored] / self.unit
        return np.asarray(weight * self.problem.predictions(theta)[:, self._scored])

    def residuals(self, place: FloatArray) -> FloatArray:
        evaluator = self.problem.evaluator
        weight = evaluator.weight[self._scored] / self.unit
        measured = weight * evaluator.measured[self._scored]
        with np.errstate(invalid="ignore", over="ignore"):
            error = self._predictions(place[None])[0] - measured
        finite = bool(np.all(np.abs(error) < _REJECTED))
        return error if finite else np.full(error.size, _REJECTED)

    def jacobian(self, place: FloatArray) -> FloatArray:
        """Forward differences away from the nearer bound, one batch of D + 1 simulations."""
        steps = np.where(place < 0.5, _DIFFERENCE, -_DIFFERENCE)
        predicted = self._predictions(np.vstack([place, place + np.diag(steps)]))
        with np.errstate(invalid="ignore", over="ignore"):
            slopes = (predicted[1:] - predicted[0]) / steps[:, None]
        return np.ascontiguousarray(np.where(np.isfinite(slopes), slopes, 0.0).T)

    def best(self, place: FloatArray) -> tuple[FloatArray, float]:
        """The solution, moved onto a bound that it only approaches if that is not worse."""
        snapped = np.where(place < _AT_BOUND, 0.0, np.where(place > 1 - _AT_BOUND, 1.0, place))
        theta = located(self.problem.evaluator, np.vstack([snapped, place]))
        values = self.problem.fitness(theta)
        self.evaluations += 2
        chosen = 0 if values[0] <= values[1] * (1 + 1e-9) else 1
        return theta[chosen], float(values[chosen])
