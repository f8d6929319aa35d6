"""Fitness and predictions of a population, as compiled functions that a search calls.

`Evaluator` holds the numbers and arrays that compiled code needs. The result of an individual does
not depend on the others: neither on their count and order nor on the copies that fill the last
SIMD vector.
"""

from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray, IntArray
from sysid.kernels.abi import NARROW_LANES
from sysid.kernels.borrowing import compile_borrowing
from sysid.kernels.calls import call_kernel
from sysid.kernels.layout import HEAD_FIELDS


class Evaluator(NamedTuple):
    """A problem as compiled code reads it, passed unchanged to Numba functions.

    Attributes
    ----------
    kernel : int
        Address of the model's kernel (see `sysid.kernels.abi` for its signature).
    template : FloatArray, shape (K,)
        Values of all parameters, fixed ones in place, free ones arbitrary.
    free_rows : IntArray, shape (D,)
        Entries of `template` that belong to the free parameters.
    lower, upper : FloatArray, shape (D,)
    is_log : IntArray, shape (D,)
        1 where the parameter's scale is logarithmic.
    offsets : IntArray, shape (E, 3)
        For each experiment: its first entry in `ints`, in `floats`, and among the M measured
        values.
    ints : IntArray
    floats : FloatArray
    n_work : int
        Length of the work array that a call of the kernel needs.
    n_measured : int
        M, measured values over all experiments and outputs.
    n_stored : int
        M, or 2M if measurements correct the states: predictions and deviations of innovations.
    weight : FloatArray, shape (M,)
        Square root of each measured value's weight; 0 where it is not scored or missing.
    measured : FloatArray, shape (M,)
        0 where missing.
    n_scored : float
        Number of scored values: J = sqrt(loss / n_scored).
    """

    kernel: int
    template: FloatArray
    free_rows: IntArray
    lower: FloatArray
    upper: FloatArray
    is_log: IntArray
    offsets: IntArray
    ints: IntArray
    floats: FloatArray
    n_work: int
    n_measured: int
    n_stored: int
    weight: FloatArray
    measured: FloatArray
    n_scored: float


_LAST_STEP = HEAD_FIELDS.index("last")
_LARGE = 1e100  # product of deviations whose logarithm is taken


@compile_borrowing
def expand_individuals(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Expand individuals (P, D) to all parameters in the kernel's layout, (K, P rounded up)."""
    individuals, free = theta.shape
    stride = (individuals + NARROW_LANES - 1) // NARROW_LANES * NARROW_LANES
    full = np.empty((evaluator.template.size, stride))
    for row in range(evaluator.template.size):
        full[row, :] = evaluator.template[row]
    for column in range(free):
        row = evaluator.free_rows[column]
        for p in range(stride):
            full[row, p] = theta[min(p, individuals - 1), column]
    return full


@compile_borrowing
def _run_kernels(
    evaluator: Evaluator, ints: IntArray, full: FloatArray, predictions: FloatArray
) -> FloatArray:
    loss = np.zeros((max(evaluator.n_stored // max(evaluator.n_measured, 1), 1), full.shape[1]))
    if full.shape[1] == 0:
        return loss
    work = np.empty(evaluator.n_work)
    for e in range(evaluator.offsets.shape[0]):
        call_kernel(
            evaluator.kernel,
            full,
            ints,
            evaluator.offsets[e, 0],
            evaluator.floats,
            evaluator.offsets[e, 1],
            work,
            predictions,
            evaluator.offsets[e, 2],
            loss,
        )
    return loss


@compile_borrowing
def evaluate_population(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Compute J of each individual (Eq. 10): (P, D) → (P,), inf if diverged. Smaller is better.

    If measurements correct the states, J = √(Σ w²e²/S / n · Π S^(1/n)).
    """
    loss = _run_kernels(
        evaluator, evaluator.ints, expand_individuals(evaluator, theta), np.empty((0, 1))
    )
    fitness = np.empty(theta.shape[0])
    for p in range(theta.shape[0]):
        value = np.sqrt(loss[0, p] / evaluator.n_scored)
        if loss.shape[0] > 1:
            value *= np.exp(0.5 * loss[1, p] / evaluator.n_scored)
        fitness[p] = value if np.isfinite(value) else np.inf
    return fitness


@compile_borrowing
def predict_population(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Simulate the values at the measured times: (P, D) → (P, M), not finite where it diverges.

    If measurements correct the states, the errors of these values are standardised innovations.
    """
    full = expand_individuals(evaluator, theta)
    predictions = np.empty((evaluator.n_stored, full.shape[1]))
    _run_kernels(evaluator, evaluator.ints, full, predictions)
    _standardise(evaluator, predictions, theta.shape[0])
    return np.ascontiguousarray(predictions[: evaluator.n_measured, : theta.shape[0]].T)


@compile_borrowing
def predict_ahead(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Predict the measured values as they are, and the deviations √S: (P, D) → (P, M or 2M)."""
    full = expand_individuals(evaluator, theta)
    predictions = np.empty((evaluator.n_stored, full.shape[1]))
    _run_kernels(evaluator, evaluator.ints, full, predictions)
    return np.ascontiguousarray(predictions[:, : theta.shape[0]].T)


@compile_borrowing
def _standardise(evaluator: Evaluator, predictions: FloatArray, individuals: int) -> None:
    """Divide innovations by their deviations over the geometric mean, in place, where scored.

    Then the sum of their squares is exp(-2/n times the logarithm of the likelihood), up to a
    factor, for the most likely variance of the sensor (Ansley, Biometrika 66 (1979) 59). Samples
    that were not reached have a deviation of 0, and do not count.
    """
    n = evaluator.n_measured
    if evaluator.n_stored == n:
        return
    for p in range(individuals):
        count, total, product = 0, 0.0, 1.0
        for m in range(n):
            if evaluator.weight[m] != 0.0 and predictions[n + m, p] != 0.0:
                product *= predictions[n + m, p]
                count += 1
                if not product < _LARGE:
                    total, product = total + np.log(product), 1.0
        mean = np.exp((total + np.log(product)) / max(count, 1))
        for m in range(n):
            if evaluator.weight[m] != 0.0 and predictions[n + m, p] != 0.0:
                error = predictions[m, p] - evaluator.measured[m]
                predictions[m, p] = evaluator.measured[m] + error * (mean / predictions[n + m, p])


@compile_borrowing
def predict_partially(evaluator: Evaluator, theta: FloatArray, horizon: float) -> FloatArray:
    """Simulate the first part of each experiment: values (M, P rounded up).

    The simulation stops after the share `horizon` (0 … 1) of the steps, and costs that share.
    Values of later samples and in columns from P on are arbitrary.
    """
    ints = evaluator.ints.copy()
    for e in range(evaluator.offsets.shape[0]):
        last = evaluator.offsets[e, 0] + _LAST_STEP
        ints[last] = int(np.ceil(horizon * ints[last]))
    full = expand_individuals(evaluator, theta)
    predictions = np.empty((evaluator.n_stored, full.shape[1]))
    predictions[evaluator.n_measured :] = 0.0
    _run_kernels(evaluator, ints, full, predictions)
    _standardise(evaluator, predictions, theta.shape[0])
    return predictions[: evaluator.n_measured]
