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
from typing import NamedTuple

import numpy as np

from sysid.core.jit import compiled
from sysid.core.types import FloatArray, IntArray
from sysid.search.levenberg_marquardt import damped_step, product
from sysid.simulation.evaluator import Evaluator, partial_predictions
from sysid.simulation.scaling import located

_DAMPINGS = np.array([0.0, 1e-4, 1e-2, 1.0, 1e2])
"""Tried in one batch, times the present damping; 0 stands for the least one."""
TRIED = _DAMPINGS.size
"""Simulations of a batch of steps; the Jacobian takes one for each parameter besides."""
_LEAST, _MOST = 1e-11, 1e12
_STOPPED = 2  # steps in a row that gain next to nothing
_DIFFERENCE = 1e-6  # of the range

_N_MEMORY = 6
_VALUE, _DAMPING, _IDLE, _FRESH, _SPENT, _END = range(_N_MEMORY)
"""What a search remembers: the loss at its place, the damping, steps in a row that gained next to
nothing, whether the Jacobian is of this place, simulations run, whether it is at its end."""


class Scored(NamedTuple):
    """A problem's scored samples: which of the M measured values, and the weight of each."""

    evaluator: Evaluator
    rows: IntArray
    weight: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
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
    is_cut_short : bool
        Whether it was too late to go on.
    """

    place: FloatArray
    is_converged: bool
    evaluations: int
    is_cut_short: bool = False


def solve(
    scored: Scored, place: FloatArray, scale: float, *, steps: int, at_once: int,
    tolerance: float = 1e-10, is_late: Callable[[], bool] | None = None,
) -> Solution:  # fmt: skip
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
    place = np.array(place)
    error, columns = np.empty(scored.rows.size), np.empty((place.size, scored.rows.size))
    memory, is_cut_short = np.zeros(_N_MEMORY), False
    while steps > 0 and not memory[_END] and not is_cut_short:
        _descend(scored, place, error, columns, memory, scale, min(steps, at_once), tolerance)
        steps -= at_once
        goes_on = steps > 0 and not memory[_END]
        is_cut_short = goes_on and is_late is not None and is_late()
    return Solution(place, bool(memory[_END]), int(memory[_SPENT]), is_cut_short)


@compiled
def _descend(
    scored: Scored, place: FloatArray, error: FloatArray, columns: FloatArray, memory: FloatArray,
    scale: float, steps: int, tolerance: float,
) -> None:  # fmt: skip
    """Go some steps on from a place (D,) with residuals (n,) and slopes (D, n), all in place."""
    if memory[_SPENT] == 0.0:
        error[:] = residuals(scored, place.reshape((1, place.size)))[0]
        memory[_VALUE], memory[_DAMPING], memory[_SPENT] = _total(error, scale), 1e-3, 1.0
    for _ in range(steps):
        if not memory[_END]:
            _step(scored, place, error, columns, memory, scale, tolerance)


@compiled
def _step(
    scored: Scored, place: FloatArray, error: FloatArray, columns: FloatArray, memory: FloatArray,
    scale: float, tolerance: float,
) -> None:  # fmt: skip
    """One step, the best of those tried; or a larger damping where none gains."""
    if not memory[_FRESH]:
        _slopes(scored, place, error, columns)
        memory[_FRESH], memory[_SPENT] = 1.0, memory[_SPENT] + place.size
    tried = np.maximum(_DAMPINGS * memory[_DAMPING], _LEAST)
    places, promised = _proposals(error, columns, place, tried, scale)
    if promised <= tolerance * memory[_VALUE]:
        memory[_END] = 1.0
        return
    errors = residuals(scored, places)
    memory[_SPENT] += TRIED
    best, value = _least(errors, memory[_VALUE], scale)
    if best < 0:
        memory[_DAMPING] *= 1e3
        if memory[_DAMPING] > _MOST:  # no step gains: rounding is all that is left
            memory[_END] = 1.0
        return
    gained = (memory[_VALUE] - value) / memory[_VALUE]
    place[:], error[:], memory[_VALUE], memory[_FRESH] = places[best], errors[best], value, 0.0
    damping = tried[best] if best > 0 else memory[_DAMPING] * 1e-2
    memory[_DAMPING] = min(max(damping, _LEAST), _MOST)
    memory[_IDLE] = memory[_IDLE] + 1.0 if gained <= tolerance else 0.0
    if memory[_IDLE] == _STOPPED:
        memory[_END] = 1.0


@compiled
def _least(errors: FloatArray, value: float, scale: float) -> tuple[int, float]:
    """Which residuals (P, n) have the least loss below `value`, -1 if none has, and that loss."""
    best = -1
    for p in range(errors.shape[0]):
        total = _total(errors[p], scale)
        if total < value:
            best, value = p, total
    return best, value


@compiled
def residuals(scored: Scored, places: FloatArray) -> FloatArray:
    """Weighted residuals (P, n) of the scored values at places (P, D)."""
    evaluator = scored.evaluator
    predicted = partial_predictions(evaluator, located(evaluator, places), 1.0)
    errors = np.empty((places.shape[0], scored.rows.size))
    for i in range(scored.rows.size):
        row = scored.rows[i]
        for p in range(places.shape[0]):
            errors[p, i] = scored.weight[i] * (predicted[row, p] - evaluator.measured[row])
    return errors


@compiled
def _slopes(scored: Scored, place: FloatArray, error: FloatArray, columns: FloatArray) -> None:
    """Write the slopes (D, n) of the residuals (n,) at a place (D,); 0 where a neighbour diverges.

    By forward differences away from the nearer bound, one batch of D simulations.
    """
    evaluator = scored.evaluator
    places, steps = np.empty((place.size, place.size)), np.empty(place.size)
    for d in range(place.size):
        steps[d] = _DIFFERENCE if place[d] < 0.5 else -_DIFFERENCE
        for k in range(place.size):
            places[d, k] = place[k] + (steps[d] if k == d else 0.0)
    predicted = partial_predictions(evaluator, located(evaluator, places), 1.0)
    for i in range(scored.rows.size):
        row = scored.rows[i]
        for d in range(place.size):
            there = scored.weight[i] * (predicted[row, d] - evaluator.measured[row])
            slope = (there - error[i]) / steps[d]
            columns[d, i] = slope if np.isfinite(slope) else 0.0


@compiled
def _total(error: FloatArray, scale: float) -> float:
    """The loss of residuals (n,); ``inf`` where one is not finite."""
    if scale == 0.0:
        total = product(error, error, error.size)
    else:
        total = 0.0
        for m in range(error.size):
            total += 2.0 * scale**2 * (np.sqrt(1.0 + (error[m] / scale) ** 2) - 1.0)
    return total if np.isfinite(total) else np.inf


@compiled
def _normal_equations(
    error: FloatArray, columns: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray]:
    """JᵀJ and Jᵀe of residuals (n,) and slopes (D, n), reweighted for the loss's slope here."""
    d, n = columns.shape
    if scale > 0.0:
        rooted, rows = np.empty(n), np.empty((d, n))
        for m in range(n):
            root = (1.0 + (error[m] / scale) ** 2) ** -0.25
            rooted[m] = root * error[m]
            for i in range(d):
                rows[i, m] = root * columns[i, m]
        error, columns = rooted, rows
    normal, slope = np.zeros((d, d)), np.empty(d)
    for i in range(d):
        slope[i] = product(columns[i], error, n)
        for j in range(i + 1):
            normal[i, j] = product(columns[i], columns[j], n)
    return normal, slope


@compiled
def _proposals(
    error: FloatArray, columns: FloatArray, place: FloatArray, damping: FloatArray, scale: float
) -> tuple[FloatArray, float]:
    """Places (P, D) after the step of each damping (P,), and the largest gain that one promises.

    That of a step cut off at the bounds is less than the whole step's.
    """
    normal, slope = _normal_equations(error, columns, scale)
    places, promised = np.empty((damping.size, place.size)), 0.0
    for p in range(damping.size):
        damped_step(normal, slope, place, damping[p], places[p])
        gain = 0.0
        for d in range(place.size):
            gain -= slope[d] * (places[p, d] - place[d])
        promised = max(promised, gain)
    return places, promised
