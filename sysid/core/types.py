"""Array types of the numerical core, and the dimension letters that docstrings use.

N samples of a record, M measured output values that are compared, P individuals of a population,
D free parameters, K all parameters (free and fixed), E experiments, W lanes of a kernel.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.int64]
WordArray: TypeAlias = NDArray[np.uint32]
"""Chromosomes: one unsigned word per free parameter, of which `bits` bits are used."""

Interval: TypeAlias = tuple[float, float]
"""Lower and upper end."""

RANK = 1e-7  # of the largest singular value: below, the differences are rounding
