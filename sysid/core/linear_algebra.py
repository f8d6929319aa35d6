"""Singular value decomposition, with the rank determined up to rounding."""

from typing import NamedTuple

import numpy as np

from sysid.core.types import RANK_TOLERANCE, BoolArray, FloatArray


class TruncatedSvd(NamedTuple):
    """Singular values (K,), left vectors (N, K), right vectors (K, D), and `retained` (K,).

    K = min(N, D). A value is retained if it exceeds the rounding of the largest.
    """

    left: FloatArray
    singular: FloatArray
    rows: FloatArray
    retained: BoolArray


def compute_truncated_svd(columns: FloatArray) -> TruncatedSvd:
    """Decompose columns (N, D) and mark the singular values above rounding."""
    left, singular, rows = np.linalg.svd(columns, full_matrices=False)
    return TruncatedSvd(
        left, singular, rows, singular > RANK_TOLERANCE * max(singular[0], np.finfo(float).tiny)
    )
