"""What compiled code needs to evaluate a population: one tuple of numbers and arrays."""

from typing import NamedTuple

from sysid.types import FloatArray, IntArray


class Evaluator(NamedTuple):
    """A problem as compiled code sees it; passed to Numba functions as it is.

    Attributes
    ----------
    kernel : int
        Address of the model's kernel (see `sysid.kernels.calls` for its signature).
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
