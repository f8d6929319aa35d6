"""Small sums and matrices of the local analysis, compiled.

n samples, D parameters. Points and sensitivities are in unit coordinates p in [0, 1].
"""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import BoolArray, FloatArray


@jit_compile
def compute_descent(columns: FloatArray, influence: FloatArray) -> FloatArray:
    """Compute -Sᵀψ (D,), the direction in which the loss falls, of sensitivities (n, D)."""
    downhill = np.zeros(columns.shape[1])
    for i in range(columns.shape[0]):
        for d in range(downhill.size):
            downhill[d] -= columns[i, d] * influence[i]
    return downhill


@jit_compile
def compute_explained_share(left: FloatArray, retained: BoolArray, influence: FloatArray) -> float:
    """Compute the share of Σψ² that the retained of orthonormal columns (n, K) explain."""
    parts = compute_descent(left, influence)
    explained = total = 0.0
    for k in range(parts.size):
        explained += parts[k] ** 2 if retained[k] else 0.0
    for i in range(influence.size):
        total += influence[i] ** 2
    return explained / total if total > 0.0 else 0.0


@jit_compile
def invert_squared(singular: FloatArray, rows: FloatArray, retained: BoolArray) -> FloatArray:
    """Compute (SᵀS)⁻¹ (D, D) in the retained directions of the singular value decomposition."""
    d = rows.shape[1]
    inverse = np.zeros((d, d))
    for k in range(singular.size):
        if retained[k]:
            for i in range(d):
                for j in range(d):
                    inverse[i, j] += rows[k, i] * rows[k, j] / singular[k] ** 2
    return inverse


@jit_compile
def scale_matrix(matrix: FloatArray, scale: FloatArray) -> FloatArray:
    """Scale rows and columns of a matrix (D, D)."""
    scaled = np.empty(matrix.shape)
    for i in range(scale.size):
        for j in range(scale.size):
            scaled[i, j] = matrix[i, j] * (scale[i] * scale[j])
    return scaled


@jit_compile
def compute_correlation(covariance: FloatArray) -> FloatArray:
    """Compute the correlation (D, D) of a covariance; 0 with a value that has no variance."""
    correlation = np.zeros(covariance.shape)
    for i in range(covariance.shape[0]):
        correlation[i, i] = 1.0
        for j in range(covariance.shape[0]):
            size = np.sqrt(covariance[i, i]) * np.sqrt(covariance[j, j])
            if i != j and size > 0.0:
                correlation[i, j] = min(max(covariance[i, j] / size, -1.0), 1.0)
    return correlation
