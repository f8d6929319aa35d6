"""Levenberg–Marquardt steps within bounds: differences, normal equations, damped steps.

With the soft-l1 loss the residuals are weighted by 1/√(1 + (e/s)²) (iteratively reweighted least
squares).
"""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray
from sysid.kernels.borrowing import compile_borrowing
from sysid.kernels.inner_products import N_SUMS, sum_products
from sysid.simulation.loss import compute_loss as _plain_loss
from sysid.simulation.loss import compute_loss_weight as _plain_weight

compute_loss = jit_compile(_plain_loss)
_compute_loss_weight = jit_compile(_plain_weight)

FINE_DIFFERENCE = 1e-6  # of the range: far above rounding, far below the scale of curvature


@compile_borrowing
def compute_inner_product(first: FloatArray, second: FloatArray, count: int) -> float:
    """Compute the inner product of the first `count` entries, as four independent sums."""
    whole = count // N_SUMS * N_SUMS
    sums: tuple[float, float, float, float] = sum_products(first, second, whole)
    a, b, c, d = sums
    for m in range(whole, count):
        a += first[m] * second[m]
    return (a + b) + (c + d)


@compile_borrowing
def step_aside(point: FloatArray, distance: float) -> tuple[FloatArray, FloatArray]:
    """Return a point (D,) with its D neighbours, (D + 1, D), and their signed distances (D,).

    Each neighbour differs in one parameter, away from the nearer bound.
    """
    n = point.size
    points, steps = np.empty((n + 1, n)), np.empty(n)
    for d in range(n):
        for p in range(n + 1):
            points[p, d] = point[d]
        steps[d] = distance if point[d] < 0.5 else -distance
        points[d + 1, d] += steps[d]
    return points, steps


@compile_borrowing
def form_normal_equations(
    error: FloatArray, columns: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray]:
    """Form JᵀJ (lower half) and Jᵀe of residuals (n,) and slopes (D, n), weighted by the loss.

    Slopes may have more columns; the first n count.
    """
    d, n = columns.shape[0], error.size
    if scale > 0.0:
        weighted_error, weighted_columns = np.empty(n), np.empty((d, n))
        for m in range(n):
            weight_root = np.sqrt(_compute_loss_weight(error[m], scale))
            weighted_error[m] = weight_root * error[m]
            for i in range(d):
                weighted_columns[i, m] = weight_root * columns[i, m]
        error, columns = weighted_error, weighted_columns
    matrix, gradient = np.zeros((d, d)), np.empty(d)
    for i in range(d):
        gradient[i] = compute_inner_product(columns[i], error, n)
        for j in range(i + 1):
            matrix[i, j] = compute_inner_product(columns[i], columns[j], n)
    return matrix, gradient


@compile_borrowing
def factor_damped(
    matrix: FloatArray, gradient: FloatArray, point: FloatArray, damping: float
) -> FloatArray:
    """Compute the lower Cholesky factor of A + λ diag A, with zero rows for parameters that stay.

    These are parameters at a bound that would leave it, parameters without effect on the output,
    and parameters whose effect is a combination of others' (no positive pivot).
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


@jit_compile
def _solve_transposed(factor: FloatArray, vector: FloatArray) -> None:
    """Solve Lᵀ x = v in place; parameters that stay get zero."""
    for d in range(vector.size - 1, -1, -1):
        for k in range(d + 1, vector.size):
            vector[d] -= factor[k, d] * vector[k]
        vector[d] = vector[d] / factor[d, d] if factor[d, d] > 0.0 else 0.0


@jit_compile
def _move_within_bounds(point: FloatArray, step: FloatArray, target: FloatArray) -> None:
    for d in range(point.size):
        target[d] = min(max(point[d] + step[d], 0.0), 1.0)


@compile_borrowing
def solve_step(factor: FloatArray, gradient: FloatArray) -> FloatArray:
    """Solve the step p (D,) of L Lᵀ p = −g; parameters that stay get zero."""
    step = np.zeros(gradient.size)
    for d in range(gradient.size):
        if factor[d, d] > 0.0:
            value = -gradient[d]
            for k in range(d):
                value -= factor[d, k] * step[k]
            step[d] = value / factor[d, d]
    _solve_transposed(factor, step)
    return step


@compile_borrowing
def write_damped_step(
    matrix: FloatArray, gradient: FloatArray, point: FloatArray, damping: float, target: FloatArray
) -> float:
    """Write the point after the step p of (A + λ diag A) p = −g, kept inside [0, 1].

    Returns the promised gain, −gᵀ times the step within the bounds: the linear part of the loss.
    """
    step = solve_step(factor_damped(matrix, gradient, point, damping), gradient)
    _move_within_bounds(point, step, target)
    promised = 0.0
    for d in range(point.size):
        promised -= gradient[d] * (target[d] - point[d])
    return promised


@compile_borrowing
def write_spread_point(
    factor: FloatArray, point: FloatArray, deviation: FloatArray, target: FloatArray
) -> None:
    """Write a point whose distance from `point` has covariance A⁻¹, for normal `deviation`.

    The distance is long where the output is insensitive, and short across the valley. `factor` is
    that of A.
    """
    _solve_transposed(factor, deviation)
    _move_within_bounds(point, deviation, target)
