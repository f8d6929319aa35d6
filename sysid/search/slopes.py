"""One Levenberg–Marquardt step inside the box of places: Jacobian, damped solutions.

The sensitivities come from forward differences, all columns in one call of the kernel. With the
soft-l1 loss the residuals are weighted by 1/√(1 + (we/s)²) (iteratively reweighted squares).
"""

import numpy as np

from sysid.core.jit import compiled
from sysid.core.types import FloatArray
from sysid.search.levenberg_marquardt import product
from sysid.search.operators import DEVELOPMENT, draws, unit
from sysid.search.state import Plan
from sysid.simulation.evaluator import Evaluator, partial_predictions
from sysid.simulation.scaling import located

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
def slope_distance(plan: Plan, search: np.record) -> float:
    """Distance (of the range) over which the next slopes are taken.

    The first searches take derivatives, the others slopes over a distance that each step draws
    anew: where switches (dry friction) make the fitness rough, these tell what lies behind the
    next ripple, and no ripple stops them all.
    """
    if search.wide_differences == 0:
        return FINE
    word = draws(plan.seed, DEVELOPMENT, plan.island, search.generation, 0)
    return float(10.0 ** (-2.0 - 4.0 * unit(word[2])))


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
