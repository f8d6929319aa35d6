"""Bounded least squares on places in [0, 1], several damped steps tried in one batch.

Levenberg-Marquardt with Marquardt's scaling [1]_; a place at a bound whose slope leads outwards is
held there. Robust losses go by reweighting. The batches are what our kernels are made for: one
gives the residuals of the steps for several dampings, one those for the Jacobian.

.. [1] D. W. Marquardt, An algorithm for least-squares estimation of nonlinear parameters,
   SIAM J. Appl. Math. 11 (1963) 431.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sysid.ga.gauss_newton import damped_step
from sysid.kernels.caching import compiled
from sysid.types import FloatArray

_DAMPINGS = np.array([0.0, 1e-4, 1e-2, 1.0, 1e2])
"""Tried in one batch, times the present damping; 0 stands for the least one."""
TRIED = _DAMPINGS.size
"""Simulations of a batch of steps; the Jacobian takes one for each parameter besides."""
_LEAST, _MOST = 1e-11, 1e12
_STOPPED = 2  # steps in a row that gain next to nothing


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where the search ended.

    Attributes
    ----------
    place : FloatArray
        (D,) in [0, 1].
    is_converged : bool
        Whether the next step promises less than the tolerance; False after too many steps.
    """

    place: FloatArray
    is_converged: bool


@dataclass(frozen=True, slots=True)
class Loss:
    """Σe², or with a scale s > 0 soft-l1, Σ 2s²(√(1 + (e/s)²) - 1)."""

    scale: float = 0.0

    def total(self, errors: FloatArray) -> FloatArray:
        """The losses (P,) of residuals (P, n); ``inf`` where one is not finite."""
        if self.scale == 0.0:
            values = np.einsum("pn,pn->p", errors, errors)
        else:
            roots = np.sqrt(1 + (errors / self.scale) ** 2)
            values = 2 * self.scale**2 * np.sum(roots - 1, axis=1)
        values[~np.isfinite(values)] = np.inf
        return np.asarray(values)


def solve(
    residuals: Callable[[FloatArray], FloatArray],
    jacobian: Callable[[FloatArray, FloatArray], FloatArray],
    place: FloatArray,
    loss: Loss,
    *,
    steps: int,
    tolerance: float = 1e-10,
) -> Solution:
    """The local minimum that Levenberg-Marquardt finds from a place (D,).

    Parameters
    ----------
    residuals : callable
        Of places (P, D), the residuals (P, n).
    jacobian : callable
        Of a place (D,) and its residuals (n,), the Jacobian (n, D).
    steps : int
        Batches of steps at most.
    tolerance : float
        Of the loss: the part that a step must promise to be worth taking.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # a simulation may diverge
        return _solved(residuals, jacobian, np.array(place), loss, steps, tolerance)


def _solved(
    residuals: Callable[[FloatArray], FloatArray],
    jacobian: Callable[[FloatArray, FloatArray], FloatArray],
    place: FloatArray, loss: Loss, steps: int, tolerance: float,
) -> Solution:  # fmt: skip
    damping, idle = 1e-3, 0
    error = residuals(place[None])[0]
    value = float(loss.total(error[None])[0])
    columns = None
    for _ in range(steps):
        tried = np.maximum(_DAMPINGS * damping, _LEAST)
        if columns is None:
            columns = np.ascontiguousarray(jacobian(place, error))
        places, promised = _proposals(error, columns, place, tried, loss.scale)
        if promised <= tolerance * value:
            return Solution(place, True)
        errors = residuals(places)
        values = loss.total(errors)
        best = int(np.argmin(values))
        if not values[best] < value:
            damping *= 1e3
            if damping > _MOST:  # no step gains: rounding is all that is left
                return Solution(place, True)
            continue
        gained = (value - values[best]) / value
        place, error, value, columns = places[best], errors[best], float(values[best]), None
        damping = float(np.clip(tried[best] if best else damping * 1e-2, _LEAST, _MOST))
        idle = idle + 1 if gained <= tolerance else 0
        if idle == _STOPPED:
            return Solution(place, True)
    return Solution(place, False)


@compiled
def _normal_equations(
    error: FloatArray, columns: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray]:
    """JᵀJ and Jᵀe of residuals (n,) and Jacobian (n, D), reweighted for the loss's slope here."""
    n, d = columns.shape
    sums, row = np.zeros((d + 1, d + 1)), np.empty(d + 1)
    for m in range(n):
        root = 1.0 if scale == 0.0 else (1.0 + (error[m] / scale) ** 2) ** -0.25
        for i in range(d):
            row[i] = root * columns[m, i]
        row[d] = root * error[m]
        for i in range(d + 1):
            for j in range(i + 1):
                sums[i, j] += row[i] * row[j]
    return sums[:d, :d], sums[d, :d].copy()


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
