"""One Levenberg–Marquardt step inside the box of places: Jacobian, damped solutions.

The sensitivities come from forward differences, all columns in one call of the kernel. With the
soft-l1 loss the residuals are weighted by 1/√(1 + (we/s)²) (iteratively reweighted squares).
"""

import numpy as np

from sysid.ga.chromosome import located
from sysid.ga.state import Plan
from sysid.kernels.caching import compiled
from sysid.kernels.evaluation import population_predictions
from sysid.kernels.evaluator import Evaluator
from sysid.types import FloatArray


@compiled
def partial_fitness(
    evaluator: Evaluator, plan: Plan, predicted: FloatArray, horizon: float
) -> float:
    """Fitness of one row of predictions over the samples up to `horizon` (1: all of them)."""
    total, count = 0.0, 0
    for m in range(predicted.size):
        weight = evaluator.weight[m]
        if weight > 0.0 and plan.progress[m] <= horizon:
            error = weight * (predicted[m] - evaluator.measured[m])
            count += 1
            if plan.loss_scale > 0.0:
                z = error / plan.loss_scale
                total += 2.0 * plan.loss_scale**2 * (np.sqrt(1.0 + z * z) - 1.0)
            else:
                total += error * error
    value = np.sqrt(total / max(count, 1))
    return value if np.isfinite(value) else np.inf


@compiled
def _sensed(
    evaluator: Evaluator, point: FloatArray, difference: float
) -> tuple[FloatArray, FloatArray]:
    """Predictions at a point and at its D neighbours, (D + 1, M), and the distances of these."""
    n = point.size
    places, steps = np.empty((n + 1, n)), np.empty(n)
    for d in range(n):
        for p in range(n + 1):
            places[p, d] = point[d]
        steps[d] = difference if point[d] < 0.5 else -difference
        places[d + 1, d] += steps[d]
    return population_predictions(evaluator, located(evaluator, places)), steps


@compiled
def _product(one: FloatArray, other: FloatArray) -> float:
    """Inner product, as four sums that do not wait for each other."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    whole = one.size // 4 * 4
    for m in range(0, whole, 4):
        a += one[m] * other[m]
        b += one[m + 1] * other[m + 1]
        c += one[m + 2] * other[m + 2]
        d += one[m + 3] * other[m + 3]
    for m in range(whole, one.size):
        a += one[m] * other[m]
    return (a + b) + (c + d)


@compiled
def normal_equations(
    evaluator: Evaluator, plan: Plan, point: FloatArray, horizon: float, difference: float
) -> tuple[FloatArray, FloatArray, float]:
    """JᵀJ, Jᵀe and the fitness at a point, over the samples up to `horizon`: D + 1 simulations."""
    n = point.size
    predicted, steps = _sensed(evaluator, point, difference)
    matrix, gradient, rows = np.zeros((n, n)), np.zeros(n), np.zeros((n + 1, predicted.shape[1]))
    for m in range(predicted.shape[1]):
        weight = evaluator.weight[m] if plan.progress[m] <= horizon else 0.0
        if weight == 0.0:
            continue
        error = weight * (predicted[0, m] - evaluator.measured[m])
        if plan.loss_scale > 0.0:
            share = (1.0 + (error / plan.loss_scale) ** 2) ** -0.25
            error, weight = share * error, share * weight
        rows[n, m] = error
        for d in range(n):
            rows[d, m] = weight * (predicted[d + 1, m] - predicted[0, m])
    for d in range(n):
        gradient[d] = _product(rows[d], rows[n]) / steps[d]
        for e in range(d + 1):
            matrix[d, e] = _product(rows[d], rows[e]) / (steps[d] * steps[e])
    return matrix, gradient, partial_fitness(evaluator, plan, predicted[0], horizon)


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
def damped_step(matrix: FloatArray, gradient: FloatArray, point: FloatArray, damping: float,
                place: FloatArray) -> None:  # fmt: skip
    """Write the place after the step p of (A + λ diag A) p = −g, kept inside [0, 1]."""
    factor = factored(matrix, gradient, point, damping)
    step = np.zeros(point.size)
    for d in range(point.size):
        if factor[d, d] > 0.0:
            value = -gradient[d]
            for k in range(d):
                value -= factor[d, k] * step[k]
            step[d] = value / factor[d, d]
    _back(factor, step)
    _shift(point, step, place)


@compiled
def spread(matrix: FloatArray, gradient: FloatArray, point: FloatArray, deviation: FloatArray,
           place: FloatArray) -> None:  # fmt: skip
    """Write a place whose distance from `point` has covariance A⁻¹, for normal `deviation`.

    Long where the output is insensitive, short across the valley.
    """
    _back(factored(matrix, gradient, point, 0.0), deviation)
    _shift(point, deviation, place)
