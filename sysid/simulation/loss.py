"""Loss of a weighted residual e: e², or soft-l1, which bounds the influence of an outlier.

Soft-l1 of scale s is 2s²(√(1 + (e/s)²) − 1). A scale of 0 means squares. The functions take numbers
and arrays, also in compiled code. The kernels have their own loss (`sysid.kernels.abi`).
"""

from typing import Any

import numpy as np


def compute_loss(error: Any, scale: float) -> Any:
    """Compute the loss ρ(e)."""
    if scale == 0.0:
        return error * error
    return 2.0 * scale**2 * (np.sqrt(1.0 + (error / scale) ** 2) - 1.0)


def compute_loss_weight(error: Any, scale: float) -> Any:
    """Compute ρ′(e)/2e = 1/√(1 + (e/s)²), the weight in iteratively reweighted least squares."""
    if scale == 0.0:
        return 1.0
    return 1.0 / np.sqrt(1.0 + (error / scale) ** 2)


def compute_influence(error: Any, scale: float) -> Any:
    """Compute ψ(e) = ρ′(e)/2, the influence of a residual; soft-l1 bounds it by s."""
    return error * compute_loss_weight(error, scale)
