"""Array types of the numerical core, and the dimension letters that docstrings use.

N: samples of a record. M: measured output values that are compared. P: individuals of a population.
D: free parameters. K: all parameters (free and fixed). E: experiments. W: lanes of a kernel.
"""

from typing import Any, TypeAlias, get_type_hints

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.int64]
WordArray: TypeAlias = NDArray[np.uint32]
"""Chromosomes: one unsigned word for each free parameter; `bits` bits of it are used."""

RANK_TOLERANCE = 1e-7  # of the largest singular value: below, the differences are rounding


def make_record_dtype(fields: type) -> np.dtype[Any]:
    """Make the dtype of records with the annotated fields of a class, each bool, int or float.

    Compiled code reads and changes such a record by the names of its fields.
    """
    types = {bool: np.bool_, int: np.int64, float: np.float64}
    return np.dtype(
        (np.record, [(name, types[kind]) for name, kind in get_type_hints(fields).items()])
    )
