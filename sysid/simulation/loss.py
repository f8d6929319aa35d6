"""The loss of a weighted residual e: e², or soft-l1, which bounds what an outlier can do.

Soft-l1 of scale s is 2s²(√(1 + (e/s)²) − 1); a scale of 0 stands for squares. These functions take
numbers as well as arrays, and compiled code takes them, too. The kernels have their own
(`sysid.kernels.abi`).
"""

from typing import Any

import numpy as np


def compute_loss(error: Any, scale: float) -> Any:
    """The loss ρ(e)."""
    if scale == 0.0:
        return error * error
    return 2.0 * scale**2 * (np.sqrt(1.0 + (error / scale) ** 2) - 1.0)


def compute_loss_weight(error: Any, scale: float) -> Any:
    """ρ′(e)/2e = 1/√(1 + (e/s)²): the weight of a square in iteratively reweighted squares."""
    if scale == 0.0:
        return 1.0
    return 1.0 / np.sqrt(1.0 + (error / scale) ** 2)


def compute_influence(error: Any, scale: float) -> Any:
    """ψ(e) = ρ′(e)/2: the residual as the loss sees it, that of an outlier bounded by s."""
    return error * compute_loss_weight(error, scale)
