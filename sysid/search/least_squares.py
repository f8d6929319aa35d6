"""Bounded least squares on places in [0, 1], several damped steps tried in one batch.

Levenberg-Marquardt with Marquardt's scaling [1]_; a place at a bound whose slope leads outwards is
held there. Robust losses go by reweighting. The batches are what our kernels are made for: one
gives the residuals of the steps for several dampings, one those for the Jacobian.

A search is compiled as a whole, but on long records cut into calls of a few steps, between which a
cancel is heard. What it needs to go on lies in its arrays, so the cuts change no bit.

.. [1] D. W. Marquardt, An algorithm for least-squares estimation of nonlinear parameters,
   SIAM J. Appl. Math. 11 (1963) 431.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray, IntArray, make_record_dtype
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
"""Tried in one batch, times the present damping; 0 stands for the least one."""
N_TRIED = _DAMPINGS.size
"""Simulations of a batch of steps; the Jacobian takes one for each parameter besides."""
_FIRST, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-11, 1e12
_MOST_IDLE_STEPS = 2  # steps in a row that gain next to nothing
_STEPS_PER_CALL = 10_000_000  # steps of integration or recursion in one compiled call: about 0.1 s


class _Progress(Protocol):
    """How far a search has got. What reads as a statement is 0 or 1."""

    loss: float  # at the place
    damping: float
    idle_steps: int  # in a row, that gained next to nothing
    has_jacobian: int  # the slopes are of this place
    evaluations: int
    has_ended: int


_PROGRESS = make_record_dtype(_Progress)


class ScoredSamples(NamedTuple):
    """A problem's scored samples: which of the M measured values, and the weight of each.

    Attributes
    ----------
    evaluator : Evaluator
    rows : IntArray, shape (n,)
    weight : FloatArray, shape (n,)
    owed : FloatArray, shape (n,), or empty
        What residuals owe to those before them (`sysid.residuals.whitening.Whitening`); empty:
        they are taken as they are.
    """

    evaluator: Evaluator
    rows: IntArray
    weight: FloatArray
    owed: FloatArray = np.zeros(0)


class _Descent(NamedTuple):
    """A search between two compiled calls, which change it in place.

    Attributes
    ----------
    place : FloatArray, shape (D,)
    error : FloatArray, shape (n,)
        Residuals there.
    columns : FloatArray, shape (D, n)
        Their slopes.
    progress : _Progress
    """

    place: FloatArray
    error: FloatArray
    columns: FloatArray
    progress: _Progress


@dataclass(frozen=True, slots=True, eq=False)
class LeastSquaresSolution:
    """Where the search ended.

    Attributes
    ----------
    place : FloatArray
        (D,) in [0, 1].
    is_converged : bool
        Whether the next step promises less than the tolerance; False after too many steps, or
        too late.
    evaluations : int
        Simulations run.
    loss : float
        Of the residuals at the place.
    is_cut_short : bool
        Whether it was too late to go on.
    """

    place: FloatArray
    is_converged: bool
    evaluations: int
    loss: float
    is_cut_short: bool = False


def solve_least_squares(
    scored: ScoredSamples,
    place: FloatArray,
    scale: float,
    *,
    steps: int,
    at_once: int,
    tolerance: float = 1e-10,
    is_late: Callable[[], bool] | None = None,
) -> LeastSquaresSolution:
    """The local minimum that Levenberg-Marquardt finds from a place (D,).

    Parameters
    ----------
    scale : float
        Of the soft-l1 loss, Σ 2s²(√(1 + (e/s)²) - 1), in the residuals' unit; 0: Σe².
    steps : int
        Batches of steps at most.
    at_once : int
        So many of them in one compiled call.
    tolerance : float
        Of the loss: the part that a step must promise to be worth taking.
    is_late : callable or None
        Asked after each call: whether to leave it at that.
    """
    progress: Any = np.zeros((), _PROGRESS).view(np.recarray)
    size, is_cut_short = scored.rows.size, False
    descent = _Descent(np.array(place), np.empty(size), np.empty((place.size, size)), progress[()])
    while steps > 0 and not progress.has_ended and not is_cut_short:
        _run_steps(scored, descent, scale, min(steps, at_once), tolerance)
        steps -= at_once
        goes_on = steps > 0 and not progress.has_ended
        is_cut_short = goes_on and is_late is not None and is_late()
    return LeastSquaresSolution(
        descent.place,
        bool(progress.has_ended),
        int(progress.evaluations),
        float(progress.loss),
        is_cut_short,
    )


def steps_at_once(n_parameters: int, n_steps: int) -> int:
    """Steps in one compiled call of about 0.1 s.

    A simulation takes `n_steps` steps of integration or recursion.
    """
    return max(1, _STEPS_PER_CALL // ((n_parameters + N_TRIED) * n_steps))


@jit_compile
def _run_steps(
    scored: ScoredSamples, descent: _Descent, scale: float, steps: int, tolerance: float
) -> None:
    """Go some steps on, in place."""
    place, progress = descent.place, descent.progress
    if progress.evaluations == 0:
        descent.error[:] = compute_residuals(scored, place.reshape((1, place.size)))[0]
        progress.loss, progress.damping = _sum_loss(descent.error, scale), _FIRST
        progress.evaluations = 1
    for _ in range(steps):
        if not progress.has_ended:
            _take_step(scored, descent, scale, tolerance)


@jit_compile
def _take_step(scored: ScoredSamples, descent: _Descent, scale: float, tolerance: float) -> None:
    """One step, the best of those tried; or a larger damping where none gains."""
    place, progress = descent.place, descent.progress
    if not progress.has_jacobian:
        fill_jacobian(scored, place, descent.error, descent.columns)
        progress.has_jacobian = 1
        progress.evaluations += place.size
    tried = np.maximum(_DAMPINGS * progress.damping, _LEAST_DAMPING)
    places, promised = _propose_places(descent, tried, scale)
    if promised <= tolerance * progress.loss:
        progress.has_ended = 1
        return
    errors = compute_residuals(scored, places)
    progress.evaluations += N_TRIED
    best, value = _find_best(errors, progress.loss, scale)
    if best < 0:
        progress.damping *= 1e3
        progress.has_ended = progress.damping > _MOST_DAMPING  # rounding is all that is left
        return
    gained = (progress.loss - value) / progress.loss
    place[:], descent.error[:] = places[best], errors[best]
    progress.loss, progress.has_jacobian = value, 0
    damping = tried[best] if best > 0 else progress.damping * 1e-2
    progress.damping = min(max(damping, _LEAST_DAMPING), _MOST_DAMPING)
    progress.idle_steps = progress.idle_steps + 1 if gained <= tolerance else 0
    progress.has_ended = progress.idle_steps == _MOST_IDLE_STEPS


@jit_compile
def _find_best(errors: FloatArray, value: float, scale: float) -> tuple[int, float]:
    """Which residuals (P, n) have the least loss below `value`, -1 if none has, and that loss."""
    best = -1
    for p in range(errors.shape[0]):
        total = _sum_loss(errors[p], scale)
        if total < value:
            best, value = p, total
    return best, value


@jit_compile
def compute_residuals(scored: ScoredSamples, places: FloatArray) -> FloatArray:
    """Weighted residuals (P, n) of the scored values at places (P, D)."""
    evaluator = scored.evaluator
    predicted = predict_partially(evaluator, from_unit(evaluator, places), 1.0)
    errors = np.empty((places.shape[0], scored.rows.size))
    for i in range(scored.rows.size):
        row = scored.rows[i]
        for p in range(places.shape[0]):
            errors[p, i] = scored.weight[i] * (predicted[row, p] - evaluator.measured[row])
    _whiten(scored.owed, errors)
    return errors


@jit_compile
def _whiten(owed: FloatArray, errors: FloatArray) -> None:
    """Take out of residuals (P, n), in place, what they owe to those before them."""
    for i in range(owed.size - 1, 0, -1):
        if owed[i] != 0.0:
            left = np.sqrt(1.0 - owed[i] * owed[i])
            for p in range(errors.shape[0]):
                errors[p, i] = (errors[p, i] - owed[i] * errors[p, i - 1]) / left


@jit_compile
def fill_jacobian(
    scored: ScoredSamples, place: FloatArray, error: FloatArray, columns: FloatArray
) -> None:
    """Write the slopes (D, n) of the residuals (n,) at a place (D,); 0 where a neighbour diverges.

    By forward differences, one batch of D simulations.
    """
    places, steps = step_aside(place, FINE_DIFFERENCE)
    errors = compute_residuals(scored, places[1:])
    for d in range(place.size):
        for i in range(error.size):
            slope = (errors[d, i] - error[i]) / steps[d]
            columns[d, i] = slope if np.isfinite(slope) else 0.0


@jit_compile
def _sum_loss(error: FloatArray, scale: float) -> float:
    """The loss of residuals (n,); ``inf`` where one is not finite."""
    if scale == 0.0:
        total = compute_inner_product(error, error, error.size)
    else:
        total = 0.0
        for m in range(error.size):
            total += compute_loss(error[m], scale)
    return total if np.isfinite(total) else np.inf


@jit_compile
def _propose_places(
    descent: _Descent, damping: FloatArray, scale: float
) -> tuple[FloatArray, float]:
    """Places (P, D) after the step of each damping (P,), and the largest gain that one promises."""
    place, promised = descent.place, 0.0
    matrix, gradient = form_normal_equations(descent.error, descent.columns, scale)
    places = np.empty((damping.size, place.size))
    for p in range(damping.size):
        gain = write_damped_step(matrix, gradient, place, damping[p], places[p])
        promised = max(promised, gain)
    return places, promised
