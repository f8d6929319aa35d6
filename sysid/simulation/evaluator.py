"""Fitness and predictions of a population, as compiled functions that a search calls.

A result of one individual does not depend on the others: not on how many they are, nor on their
order, nor on the copies that fill the last lanes.

What compiled code needs to evaluate a population: one tuple of numbers and arrays.
"""

from typing import NamedTuple

import numpy as np

from sysid.core.jit import compiled
from sysid.core.types import FloatArray, IntArray
from sysid.kernels.abi import FEW, call_kernel
from sysid.kernels.layout import HEAD


class Evaluator(NamedTuple):
    """A problem as compiled code sees it; passed to Numba functions as it is.

    Attributes
    ----------
    kernel : int
        Address of the model's kernel (see `sysid.kernels.abi` for its signature).
    template : FloatArray, shape (K,)
        Values of all parameters, fixed ones in place, free ones arbitrary.
    rows : IntArray, shape (D,)
        Which entries of `template` the free parameters are.
    lower, upper : FloatArray, shape (D,)
    log : IntArray, shape (D,)
        1 where the parameter's scale is logarithmic.
    plans : IntArray, shape (E, 3)
        Per experiment: where its numbers begin in `ints` and in `floats`, and its first measured
        value among the M.
    ints : IntArray
    floats : FloatArray
    n_work : int
        Length of the work array that a call of the kernel needs.
    n_measured : int
        M, measured values over all experiments and outputs.
    weight : FloatArray, shape (M,)
        Square root of each measured value's weight; 0 where it is not scored or missing.
    measured : FloatArray, shape (M,)
        0 where missing.
    n_weight : float
        Number of scored values: J = sqrt(loss / n_weight).
    """

    kernel: int
    template: FloatArray
    rows: IntArray
    lower: FloatArray
    upper: FloatArray
    log: IntArray
    plans: IntArray
    ints: IntArray
    floats: FloatArray
    n_work: int
    n_measured: int
    weight: FloatArray
    measured: FloatArray
    n_weight: float


_LAST = HEAD.index("last")


@compiled
def expanded(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """All parameters of (P, D) individuals as the kernel wants them: (K, P rounded up)."""
    individuals, free = theta.shape
    stride = (individuals + FEW - 1) // FEW * FEW
    full = np.empty((evaluator.template.size, stride))
    for row in range(evaluator.template.size):
        full[row, :] = evaluator.template[row]
    for column in range(free):
        row = evaluator.rows[column]
        for p in range(stride):
            full[row, p] = theta[min(p, individuals - 1), column]
    return full


@compiled
def _run(
    evaluator: Evaluator, ints: IntArray, full: FloatArray, predictions: FloatArray
) -> FloatArray:
    loss = np.zeros(full.shape[1])
    if full.shape[1] == 0:
        return loss
    work = np.empty(evaluator.n_work)
    for e in range(evaluator.plans.shape[0]):
        call_kernel(
            evaluator.kernel, full,
            ints, evaluator.plans[e, 0], evaluator.floats, evaluator.plans[e, 1],
            work, predictions, evaluator.plans[e, 2], loss,
        )  # fmt: skip
    return loss


@compiled
def population_fitness(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """J of each individual (Eq. 10; smaller is better): (P, D) → (P,), inf where it diverges."""
    loss = _run(evaluator, evaluator.ints, expanded(evaluator, theta), np.empty((0, 1)))
    fitness = np.empty(theta.shape[0])
    for p in range(theta.shape[0]):
        value = np.sqrt(loss[p] / evaluator.n_weight)
        fitness[p] = value if np.isfinite(value) else np.inf
    return fitness


@compiled
def population_predictions(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Simulated value at each measured time: (P, D) → (P, M); not finite where it diverges."""
    full = expanded(evaluator, theta)
    predictions = np.empty((evaluator.n_measured, full.shape[1]))
    _run(evaluator, evaluator.ints, full, predictions)
    return np.ascontiguousarray(predictions[:, : theta.shape[0]].T)


@compiled
def partial_predictions(evaluator: Evaluator, theta: FloatArray, horizon: float) -> FloatArray:
    """Simulated values (M, P rounded up) of each experiment up to a part of its time.

    The simulation ends `horizon` (0 … 1) of the steps after its beginning, and costs that part.
    Values of later samples and in columns from P on are arbitrary.
    """
    ints = evaluator.ints.copy()
    for e in range(evaluator.plans.shape[0]):
        last = evaluator.plans[e, 0] + _LAST
        ints[last] = int(np.ceil(horizon * ints[last]))
    full = expanded(evaluator, theta)
    predictions = np.empty((evaluator.n_measured, full.shape[1]))
    _run(evaluator, ints, full, predictions)
    return predictions
