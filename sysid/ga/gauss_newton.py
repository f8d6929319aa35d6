"""One Levenberg–Marquardt step inside the box of places: Jacobian, damped solutions.

The sensitivities come from forward differences, all columns in one call of the kernel. With the
soft-l1 loss the residuals are weighted by 1/√(1 + (we/s)²) (iteratively reweighted squares).
"""

import numpy as np

from sysid.ga.chromosome import located
from sysid.ga.random import DEVELOPMENT, draws, unit
from sysid.ga.state import GENERATION, ROUGH, Plan
from sysid.kernels.caching import compiled
from sysid.kernels.evaluation import partial_predictions
from sysid.kernels.evaluator import Evaluator
from sysid.types import FloatArray, IntArray

FINE = 1e-6  # of the range: far above rounding, far below what curvature needs


@compiled
def partial_fitness(
    evaluator: Evaluator, plan: Plan, predicted: FloatArray, horizon: float
) -> FloatArray:
    """Fitness of each column of predictions (M, P) by the samples up to `horizon` (1: all)."""
    totals, count = np.zeros(predicted.shape[1]), 0
    for m in range(predicted.shape[0]):
        weight, measured = evaluator.weight[m], evaluator.measured[m]
        if weight == 0.0 or plan.progress[m] > horizon:
            continue
        count += 1
        for p in range(totals.size):
            error = weight * (predicted[m, p] - measured)
            if plan.loss_scale > 0.0:
                z = error / plan.loss_scale
                totals[p] += 2.0 * plan.loss_scale**2 * (np.sqrt(1.0 + z * z) - 1.0)
            else:
                totals[p] += error * error
    for p in range(totals.size):
        value = np.sqrt(totals[p] / max(count, 1))
        totals[p] = value if np.isfinite(value) else np.inf
    return totals


@compiled
def _sensed(
    evaluator: Evaluator, point: FloatArray, horizon: float, difference: float
) -> tuple[FloatArray, FloatArray]:
    """Predictions at a point and its D neighbours, (M, D + 1 or more), and these' distances."""
    n = point.size
    places, steps = np.empty((n + 1, n)), np.empty(n)
    for d in range(n):
        for p in range(n + 1):
            places[p, d] = point[d]
        steps[d] = difference if point[d] < 0.5 else -difference
        places[d + 1, d] += steps[d]
    return partial_predictions(evaluator, located(evaluator, places), horizon), steps


@compiled
def slope_distance(plan: Plan, counters: IntArray, memory: FloatArray) -> float:
    """Distance (of the range) over which the next slopes are taken.

    The first searches take derivatives, the others slopes over a distance that each step draws
    anew: where switches (dry friction) make the fitness rough, these tell what lies behind the
    next ripple, and no ripple stops them all.
    """
    if memory[ROUGH] == 0.0:
        return FINE
    word = draws(plan.seed, DEVELOPMENT, plan.island, counters[GENERATION], 0)
    return float(10.0 ** (-2.0 - 4.0 * unit(word[2])))


@compiled
def product(one: FloatArray, other: FloatArray, count: int) -> float:
    """Inner product of the first `count` entries, as four sums that do not wait for each other."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    whole = count // 4 * 4
    for m in range(0, whole, 4):
        a += one[m] * other[m]
        b += one[m + 1] * other[m + 1]
        c += one[m + 2] * other[m + 2]
        d += one[m + 3] * other[m + 3]
    for m in range(whole, count):
        a += one[m] * other[m]
    return (a + b) + (c + d)


@compiled
def normal_equations(
    evaluator: Evaluator, plan: Plan, point: FloatArray, horizon: float, difference: float
) -> tuple[FloatArray, FloatArray, float]:
    """JᵀJ, Jᵀe and the fitness at a point, over the samples up to `horizon`: D + 1 simulations."""
    n = point.size
    predicted, steps = _sensed(evaluator, point, horizon, difference)
    rows, count, total = np.empty((n + 1, predicted.shape[0])), 0, 0.0
    for m in range(predicted.shape[0]):
        weight = evaluator.weight[m]
        if weight == 0.0 or plan.progress[m] > horizon:
            continue
        error = weight * (predicted[m, 0] - evaluator.measured[m])
        if plan.loss_scale > 0.0:
            root = np.sqrt(1.0 + (error / plan.loss_scale) ** 2)
            total += 2.0 * plan.loss_scale**2 * (root - 1.0)
            share = root**-0.5
            error, weight = share * error, share * weight
        else:
            total += error * error
        rows[n, count] = error
        for d in range(n):
            rows[d, count] = weight * (predicted[m, d + 1] - predicted[m, 0])
        count += 1
    matrix, gradient = np.zeros((n, n)), np.zeros(n)
    for d in range(n):
        gradient[d] = product(rows[d], rows[n], count) / steps[d]
        for e in range(d + 1):
            matrix[d, e] = product(rows[d], rows[e], count) / (steps[d] * steps[e])
    fitness = np.sqrt(total / max(count, 1))
    return matrix, gradient, fitness if np.isfinite(fitness) else np.inf


@compiled
def factored(
    matrix: FloatArray, gradient: FloatArray, point: FloatArray, damping: float
) -> FloatArray:
    """Lower Cholesky factor of A + λ diag A, with zero rows for parameters that stay.

    These are the parameters at a bound that would leave the box, those to which the output is
    insensitive, and those whose effect is a combination of others' (no positive pivot).
    """
    n = point.size
    factor = np.zeros((n, n))
    for d in range(n):
        below, above = point[d] <= 0.0 and gradient[d] > 0.0, point[d] >= 1.0 and gradient[d] < 0.0
        if below or above or not 0.0 < matrix[d, d] < np.inf:
            continue
        for e in range(d + 1):
            value = matrix[d, e] * (1.0 + damping if d == e else 1.0)
            for k in range(e):
                value -= factor[d, k] * factor[e, k]
            if d == e:
                factor[d, d] = np.sqrt(value) if value > 1e-14 * matrix[d, d] else 0.0
            elif factor[e, e] > 0.0:
                factor[d, e] = value / factor[e, e]
    return factor


@compiled
def _back(factor: FloatArray, vector: FloatArray) -> None:
    """Solve Lᵀ x = v in place; parameters that stay get zero."""
    for d in range(vector.size - 1, -1, -1):
        for k in range(d + 1, vector.size):
            vector[d] -= factor[k, d] * vector[k]
        vector[d] = vector[d] / factor[d, d] if factor[d, d] > 0.0 else 0.0


@compiled
def _shift(point: FloatArray, step: FloatArray, place: FloatArray) -> None:
    for d in range(point.size):
        place[d] = min(max(point[d] + step[d], 0.0), 1.0)


@compiled
def solved(factor: FloatArray, gradient: FloatArray) -> FloatArray:
    """The step p (D,) of L Lᵀ p = −g; parameters that stay get zero."""
    step = np.zeros(gradient.size)
    for d in range(gradient.size):
        if factor[d, d] > 0.0:
            value = -gradient[d]
            for k in range(d):
                value -= factor[d, k] * step[k]
            step[d] = value / factor[d, d]
    _back(factor, step)
    return step


@compiled
def damped_step(matrix: FloatArray, gradient: FloatArray, point: FloatArray, damping: float,
                place: FloatArray) -> float:  # fmt: skip
    """Write the place after the step p of (A + λ diag A) p = −g, kept inside [0, 1].

    Gives −gᵀp: what the whole step promises to gain, in the loss's linear part.
    """
    step = solved(factored(matrix, gradient, point, damping), gradient)
    _shift(point, step, place)
    promised = 0.0
    for d in range(point.size):
        promised -= gradient[d] * step[d]
    return promised


@compiled
def spread(factor: FloatArray, point: FloatArray, deviation: FloatArray, place: FloatArray) -> None:
    """Write a place whose distance from `point` has covariance A⁻¹, for normal `deviation`.

    Long where the output is insensitive, short across the valley. `factor` is that of A.
    """
    _back(factor, deviation)
    _shift(point, deviation, place)
