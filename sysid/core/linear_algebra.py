"""What the columns of a matrix span, without the directions that are rounding only."""

from typing import NamedTuple

import numpy as np

from sysid.core.types import RANK_TOLERANCE, BoolArray, FloatArray


class TruncatedSvd(NamedTuple):
    """Singular values (K,), vectors in columns (N, K) and rows (K, D), and which are `kept` (K,).

    K = min(N, D); a value is kept where it is more than rounding of the largest.
    """

    left: FloatArray
    singular: FloatArray
    rows: FloatArray
    kept: BoolArray


def truncated_svd(columns: FloatArray) -> TruncatedSvd:
    """Singular value decomposition of columns (N, D)."""
    left, singular, rows = np.linalg.svd(columns, full_matrices=False)
    return TruncatedSvd(
        left, singular, rows, singular > RANK_TOLERANCE * max(singular[0], np.finfo(float).tiny)
    )
