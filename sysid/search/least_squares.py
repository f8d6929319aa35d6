"""Bounded least squares on points in [0, 1], with several damped steps tried in one batch.

The method is Levenberg–Marquardt with Marquardt's scaling [1]_. A parameter at a bound whose slope
leads outwards is held there. Robust losses use iterative reweighting. Kernels evaluate batches: one
for the steps of several dampings, one for the Jacobian.

The whole search is compiled. On long records it is divided into calls of a few steps, and between
them it can be cancelled. Its state is in its arrays, so the division changes no bit.

.. [1] D. W. Marquardt, An algorithm for least-squares estimation of nonlinear parameters,
   SIAM J. Appl. Math. 11 (1963) 431.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray, IntArray, make_record_dtype
from sysid.kernels.borrowing import compile_borrowing
from sysid.search.levenberg_marquardt import (
    FINE_DIFFERENCE,
    compute_inner_product,
    compute_loss,
    form_normal_equations,
    step_aside,
    write_damped_step,
)
from sysid.simulation.evaluator import Evaluator, predict_partially
from sysid.simulation.scaling import from_unit

_DAMPINGS = np.array([0.0, 1e-4, 1e-2, 1.0, 1e2])
"""Factors of the present damping that one batch tries; 0 means the least damping."""
N_TRIED = _DAMPINGS.size
"""Simulations of a batch of steps; the Jacobian takes one more for each parameter."""
_FIRST, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e-11, 1e12
_MAX_IDLE_STEPS = 2  # consecutive steps that gain almost nothing
_STEPS_PER_CALL = 10_000_000  # steps of integration or recursion in one compiled call: about 0.1 s


class _Progress(Protocol):
    """Progress of a search."""

    loss: float  # at the present point
    damping: float
    idle_steps: int  # consecutive steps that gained almost nothing
    has_jacobian: bool  # the slopes are those of the present point
    evaluations: int
    has_ended: bool


_PROGRESS = make_record_dtype(_Progress)


class ScoredSamples(NamedTuple):
    """The scored samples of a problem: their rows among the M measured values, and weights.

    Attributes
    ----------
    evaluator : Evaluator
    rows : IntArray, shape (n,)
    weight : FloatArray, shape (n,)
    ar1_coefficient : FloatArray, shape (n,), or empty
        AR(1) coefficient of each sample (`sysid.residuals.whitening.Whitening`). Empty: the
        residuals are not whitened.
    """

    evaluator: Evaluator
    rows: IntArray
    weight: FloatArray
    ar1_coefficient: FloatArray = np.zeros(0)


class _Descent(NamedTuple):
    """State of a search between two compiled calls, which change it in place.

    Attributes
    ----------
    point : FloatArray, shape (D,)
    error : FloatArray, shape (n,)
        Residuals at the point.
    columns : FloatArray, shape (D, n)
        Slopes of the residuals.
    progress : _Progress
    """

    point: FloatArray
    error: FloatArray
    columns: FloatArray
    progress: _Progress


@dataclass(frozen=True, slots=True, eq=False)
class LeastSquaresSolution:
    """Result of a search.

    Attributes
    ----------
    point : FloatArray
        (D,) in [0, 1].
    is_converged : bool
        Whether the next step promises less than the tolerance. False after too many steps, or
        after the deadline.
    evaluations : int
        Simulations run.
    loss : float
        Loss of the residuals at the point.
    is_cut_short : bool
        Whether the deadline ended the search.
    """

    point: FloatArray
    is_converged: bool
    evaluations: int
    loss: float
    is_cut_short: bool = False


def solve_least_squares(
    scored: ScoredSamples,
    point: FloatArray,
    scale: float,
    *,
    steps: int,
    at_once: int,
    tolerance: float = 1e-10,
    is_late: Callable[[], bool] | None = None,
) -> LeastSquaresSolution:
    """Search a local minimum by Levenberg–Marquardt from a point (D,) in [0, 1].

    Parameters
    ----------
    scale : float
        Scale of the soft-l1 loss, Σ 2s²(√(1 + (e/s)²) - 1), in the residuals' unit; 0: Σe².
    steps : int
        Limit on the batches of steps.
    at_once : int
        Batches in one compiled call.
    tolerance : float
        Least relative gain of the loss that a step must promise.
    is_late : callable or None
        Called after each compiled call; True ends the search.
    """
    progress: Any = np.zeros((), _PROGRESS)
    size, is_cut_short = scored.rows.size, False
    descent = _Descent(np.array(point), np.empty(size), np.empty((point.size, size)), progress[()])
    while steps > 0 and not progress["has_ended"] and not is_cut_short:
        _run_steps(scored, descent, scale, min(steps, at_once), tolerance)
        steps -= at_once
        continues = steps > 0 and not progress["has_ended"]
        is_cut_short = continues and is_late is not None and is_late()
    return LeastSquaresSolution(
        descent.point,
        bool(progress["has_ended"]),
        int(progress["evaluations"]),
        float(progress["loss"]),
        is_cut_short,
    )


def steps_at_once(n_parameters: int, n_steps: int) -> int:
    """Compute the steps of the search in one compiled call of about 0.1 s.

    A simulation takes `n_steps` steps of integration or recursion.
    """
    return max(1, _STEPS_PER_CALL // ((n_parameters + N_TRIED) * n_steps))


@compile_borrowing
def _run_steps(
    scored: ScoredSamples, descent: _Descent, scale: float, steps: int, tolerance: float
) -> None:
    """Take some steps in place."""
    point, progress = descent.point, descent.progress
    if progress.evaluations == 0:
        descent.error[:] = compute_residuals(scored, point.reshape((1, point.size)))[0]
        progress.loss, progress.damping = _sum_loss(descent.error, scale), _FIRST
        progress.evaluations = 1
    for _ in range(steps):
        if not progress.has_ended:
            _take_step(scored, descent, scale, tolerance)


@compile_borrowing
def _take_step(scored: ScoredSamples, descent: _Descent, scale: float, tolerance: float) -> None:
    """Take the best of the proposed steps, or increase the damping if none gains."""
    point, progress = descent.point, descent.progress
    if not progress.has_jacobian:
        fill_jacobian(scored, point, descent.error, descent.columns)
        progress.has_jacobian = True
        progress.evaluations += point.size
    tried = np.maximum(_DAMPINGS * progress.damping, _MIN_DAMPING)
    points, promised = _propose_points(descent, tried, scale)
    if promised <= tolerance * progress.loss:
        progress.has_ended = True
        return
    errors = compute_residuals(scored, points)
    progress.evaluations += N_TRIED
    best, value = _find_best(errors, progress.loss, scale)
    if best < 0:
        progress.damping *= 1e3
        progress.has_ended = progress.damping > _MAX_DAMPING  # the rest is rounding
        return
    gained = (progress.loss - value) / progress.loss
    point[:], descent.error[:] = points[best], errors[best]
    progress.loss, progress.has_jacobian = value, False
    damping = tried[best] if best > 0 else progress.damping * 1e-2
    progress.damping = min(max(damping, _MIN_DAMPING), _MAX_DAMPING)
    progress.idle_steps = progress.idle_steps + 1 if gained <= tolerance else 0
    progress.has_ended = progress.idle_steps == _MAX_IDLE_STEPS


@compile_borrowing
def _find_best(errors: FloatArray, value: float, scale: float) -> tuple[int, float]:
    """Find the residuals (P, n) of least loss below `value` (-1: none), and that loss."""
    best = -1
    for p in range(errors.shape[0]):
        total = _sum_loss(errors[p], scale)
        if total < value:
            best, value = p, total
    return best, value


@compile_borrowing
def compute_residuals(scored: ScoredSamples, points: FloatArray) -> FloatArray:
    """Compute the weighted residuals (P, n) of the scored values at points (P, D)."""
    evaluator = scored.evaluator
    predicted = predict_partially(evaluator, from_unit(evaluator, points), 1.0)
    errors = np.empty((points.shape[0], scored.rows.size))
    for p in range(points.shape[0]):
        for i in range(scored.rows.size):
            row = scored.rows[i]
            errors[p, i] = scored.weight[i] * (predicted[row, p] - evaluator.measured[row])
    _whiten(scored.ar1_coefficient, errors)
    return errors


@compile_borrowing
def _whiten(ar1_coefficient: FloatArray, errors: FloatArray) -> None:
    """Whiten residuals (P, n) in place by the AR(1) coefficient of each sample."""
    for i in range(ar1_coefficient.size - 1, 0, -1):
        if ar1_coefficient[i] != 0.0:
            innovation_deviation = np.sqrt(1.0 - ar1_coefficient[i] * ar1_coefficient[i])
            for p in range(errors.shape[0]):
                errors[p, i] = (
                    errors[p, i] - ar1_coefficient[i] * errors[p, i - 1]
                ) / innovation_deviation


@compile_borrowing
def fill_jacobian(
    scored: ScoredSamples, point: FloatArray, error: FloatArray, columns: FloatArray
) -> None:
    """Write the slopes (D, n) of the residuals (n,) at a point (D,); 0 where a neighbour diverges.

    Forward differences: one batch of D simulations.
    """
    points, steps = step_aside(point, FINE_DIFFERENCE)
    errors = compute_residuals(scored, points[1:])
    for d in range(point.size):
        for i in range(error.size):
            slope = (errors[d, i] - error[i]) / steps[d]
            columns[d, i] = slope if np.isfinite(slope) else 0.0


@jit_compile
def _sum_loss(error: FloatArray, scale: float) -> float:
    """Sum the loss of residuals (n,); ``inf`` if it is not finite."""
    if scale == 0.0:
        total = compute_inner_product(error, error, error.size)
    else:
        total = 0.0
        for m in range(error.size):
            total += compute_loss(error[m], scale)
    return total if np.isfinite(total) else np.inf


@compile_borrowing
def _propose_points(
    descent: _Descent, damping: FloatArray, scale: float
) -> tuple[FloatArray, float]:
    """Propose points (P, D) for dampings (P,); return them and the largest promised gain."""
    point, promised = descent.point, 0.0
    matrix, gradient = form_normal_equations(descent.error, descent.columns, scale)
    points = np.empty((damping.size, point.size))
    for p in range(damping.size):
        gain = write_damped_step(matrix, gradient, point, damping[p], points[p])
        promised = max(promised, gain)
    return points, promised
