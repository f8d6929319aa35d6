"""Sums with a decay, as compiled code: what a pole makes of its input."""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray


def sum_with_decay(values: FloatArray, decay: complex, last: int | None = None) -> FloatArray:
    """Sum columns (n, q) with a decay per row, a complex number of size 1 at most.

    Returns the real parts of the `last` rows, of all by default, and the imaginary parts too if the
    decay has one: (1 or 2, last, q).
    """
    kept = values.shape[0] if last is None else last
    sums = np.empty((2 if decay.imag else 1, kept, values.shape[1]))
    _sum_with_decay(values, decay.real, decay.imag, sums)
    return sums


@jit_compile
def _sum_with_decay(values: FloatArray, real: float, imaginary: float, sums: FloatArray) -> None:
    """Fill the parts of sums (1 or 2, last, q) of columns (n, q)."""
    rows, columns = values.shape
    skipped = rows - sums.shape[1]
    first, second = np.zeros(columns), np.zeros(columns)
    for row in range(rows):
        for column in range(columns):
            one, other = first[column], second[column]
            first[column] = values[row, column] + real * one - imaginary * other
            second[column] = real * other + imaginary * one
            if row >= skipped:
                sums[0, row - skipped, column] = first[column]
                if sums.shape[0] > 1:
                    sums[1, row - skipped, column] = second[column]
