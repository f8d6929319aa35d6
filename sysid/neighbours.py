"""Minima beside an estimate: where the loss is rough, least squares ends at one of many.

Switches such as dry friction make the loss jump, so that minima lie side by side inside the
statistical ellipsoid, with losses that the noise hardly tells apart. Places are drawn along the
estimate's covariance; if the loss there is what the linear model says, nothing more is done. Else
least squares goes on from each, and again from around a better minimum (basin hopping, Wales and
Doye, J. Phys. Chem. A 101 (1997) 5111).

A minimum whose likelihood ratio n ln(Σe²/Σe²₀) is below the square of the interval's quantile is
inside the profile likelihood region (Venzon and Moolgavkar, Appl. Statist. 37 (1988) 87). With the
curvature of the best, each such minimum holds the values within √(q² − ratio) standard errors, and
the interval is from the least of all these to the largest.
"""

from dataclasses import dataclass, replace

import numpy as np

from sysid.problem import Problem
from sysid.refinement import Refined, refine_one
from sysid.result import Estimate
from sysid.types import FloatArray

_SIZES = np.array([0.5, 1.0, 2.0, 3.0])  # standard errors
_DRAWN = 24  # places in a round
_ROUNDS = 3
_STEPS = 12  # of least squares from each place
_LINEAR = 0.5  # of the linear model's likelihood ratio: deviations that are no roughness
_LONG = 2_000_000  # measured values times parameters: from here on, nothing is looked for
_BETTER = 1e-9  # relative


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """What was found beside an estimate.

    Attributes
    ----------
    best : Refined or None
        A better minimum; None where the estimate is the best.
    values : FloatArray, shape (m, D)
        All minima, none where the loss is as the linear model says.
    rms : FloatArray, shape (m,)
    evaluations : int
    """

    best: Refined | None
    values: FloatArray
    rms: FloatArray
    evaluations: int


def neighbourhood(
    problem: Problem, theta: FloatArray, rms: float, covariance: FloatArray, seed: int,
    left: int | None = None,
) -> Neighbourhood:  # fmt: skip
    """Look for minima around an estimate (D,) of a covariance (D, D), in at most `left` runs."""
    budget = 2**62 if left is None else left
    found, spent = [Refined(theta, rms, 0)], 0
    best = found[0]
    normal = np.random.Generator(np.random.Philox(key=seed))
    root = _root(covariance)
    if rms > 0 and root.any() and problem.evaluator.n_measured * theta.size <= _LONG:
        for turn in range(_ROUNDS):
            if budget - spent < _DRAWN:
                break
            deviations = _SIZES[np.arange(_DRAWN) % _SIZES.size, None] * normal.standard_normal(
                (_DRAWN, theta.size)
            )
            starts = best.theta + deviations @ root.T
            np.clip(starts, problem.evaluator.lower, problem.evaluator.upper, out=starts)
            values = problem.fitness(starts)
            spent += _DRAWN
            if turn == 0 and not _is_rough(problem.n_scored, values, best.rms, deviations):
                break
            for i in np.flatnonzero(np.isfinite(values)):
                end = refine_one(problem, starts[i], float(values[i]), budget - spent, _STEPS)
                if end is None:
                    break
                spent += end.evaluations
                found.append(end)
            reached = min(found, key=lambda one: one.rms)
            if not reached.rms < best.rms * (1.0 - _BETTER):
                break
            best = reached
    return Neighbourhood(
        best if best is not found[0] else None, np.array([one.theta for one in found]),
        np.array([one.rms for one in found]), spent,
    )  # fmt: skip


def _root(covariance: FloatArray) -> FloatArray:
    """A matrix R (D, D) with R Rᵀ the covariance."""
    size, rows = np.linalg.eigh(covariance)
    return np.asarray(rows * np.sqrt(np.maximum(size, 0.0)))


def _is_rough(n: int, values: FloatArray, rms: float, deviations: FloatArray) -> bool:
    """Whether losses differ from those of a linear model, by their likelihood ratios."""
    expected = np.einsum("pd,pd->p", deviations, deviations)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = 2.0 * n * np.log(values / rms)
    return bool(np.any(~(np.abs(ratio - expected) <= _LINEAR * np.maximum(expected, 1.0))))


def widened(
    estimates: tuple[Estimate, ...], names: tuple[str, ...], n: int, found: Neighbourhood
) -> tuple[Estimate, ...]:
    """Estimates whose intervals hold those of all minima that the data do not rule out."""
    ratio = 2.0 * n * np.log(found.rms / found.rms.min()) if found.rms.min() > 0 else np.zeros(1)
    changed = []
    for one in estimates:
        if one.name in names and one.stderr and one.interval95 is not None:
            # On a plateau the interval is around its middle; of noiseless data it has no width.
            lower, upper = one.interval95
            quantile, aside = (upper - lower) / (2.0 * one.stderr), (lower + upper) / 2 - one.value
            kept = ratio <= quantile**2
            half = one.stderr * np.sqrt(quantile**2 - ratio[kept])
            middle = found.values[kept, names.index(one.name)] + aside
            low = min(one.interval95[0], float(np.min(middle - half)))
            high = max(one.interval95[1], float(np.max(middle + half)))
            one = replace(one, interval95=(low, high))
        changed.append(one)
    return tuple(changed)
