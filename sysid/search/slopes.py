"""Sensitivities over a part of a record, for the next Levenberg–Marquardt step of a search.

They are forward differences, with all columns from one call of the kernel.
"""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray
from sysid.kernels.borrowing import compile_borrowing
from sysid.search.levenberg_marquardt import (
    FINE_DIFFERENCE,
    compute_loss,
    form_normal_equations,
    step_aside,
)
from sysid.search.operators import USE_LOCAL_SEARCH, draw_words, to_uniform
from sysid.search.state import IslandPlan, SearchRecord
from sysid.simulation.evaluator import Evaluator, predict_partially
from sysid.simulation.scaling import from_unit


@compile_borrowing
def evaluate_partial_fitness(
    evaluator: Evaluator, plan: IslandPlan, predicted: FloatArray, horizon: float
) -> FloatArray:
    """Compute the fitness of each column of predictions (M, P) up to `horizon` (1: all)."""
    totals, count = np.zeros(predicted.shape[1]), 0
    for m in range(predicted.shape[0]):
        weight, measured = evaluator.weight[m], evaluator.measured[m]
        if weight == 0.0 or plan.progress[m] > horizon:
            continue
        count += 1
        for p in range(totals.size):
            totals[p] += compute_loss(weight * (predicted[m, p] - measured), plan.loss_scale)
    for p in range(totals.size):
        value = np.sqrt(totals[p] / max(count, 1))
        totals[p] = value if np.isfinite(value) else np.inf
    return totals


@jit_compile
def choose_difference(plan: IslandPlan, search: SearchRecord) -> float:
    """Choose the distance, as a share of the range, over which the next slopes are taken.

    The first searches use derivatives. Later ones use slopes over a random distance, drawn for each
    step. Where switching (dry friction) makes the fitness rough, such slopes look past the next
    ripple, and no ripple stops all of them.
    """
    if not search.wide_differences:
        return FINE_DIFFERENCE
    word = draw_words(plan.seed, USE_LOCAL_SEARCH, plan.island, search.generation, 0)
    return float(10.0 ** (-2.0 - 4.0 * to_uniform(word[2])))


@compile_borrowing
def build_normal_equations(
    evaluator: Evaluator, plan: IslandPlan, point: FloatArray, horizon: float, difference: float
) -> tuple[FloatArray, FloatArray, float]:
    """Compute JᵀJ, Jᵀe and the fitness at a point up to `horizon`, in D + 1 simulations."""
    n, (points, steps) = point.size, step_aside(point, difference)
    predicted = predict_partially(evaluator, from_unit(evaluator, points), horizon)
    weights, measured, progress = evaluator.weight, evaluator.measured, plan.progress
    # Unsigned, so that no row is checked for being counted from the end.
    rows, error = np.empty(weights.size, np.uint64), np.empty(weights.size)
    count, total, columns = 0, 0.0, np.empty((n, weights.size))
    for m in range(weights.size):
        if weights[m] != 0.0 and progress[m] <= horizon:
            rows[count] = m
            error[count] = weights[m] * (predicted[m, 0] - measured[m])
            total += compute_loss(error[count], plan.loss_scale)
            count += 1
    for d in range(n):
        per_step = 1.0 / steps[d]
        for i in range(count):
            m = rows[i]
            columns[d, i] = weights[m] * per_step * (predicted[m, d + 1] - predicted[m, 0])
    matrix, gradient = form_normal_equations(error[:count], columns, plan.loss_scale)
    fitness = np.sqrt(total / max(count, 1))
    return matrix, gradient, fitness if np.isfinite(fitness) else np.inf
