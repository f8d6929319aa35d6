"""The Cramér–Rao bound of a model's parameters at their true values."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lagid import Channel, simulate

RELATIVE_STEP = 1e-4


def cramer_rao_bound(
    model: str | Mapping[str, object],
    inputs: Sequence[Channel],
    true: Mapping[str, float],
    sigma: float,
    times: NDArray[np.float64],
) -> dict[str, float]:
    """Compute each parameter's smallest standard deviation that an unbiased estimator can reach.

    For white Gaussian measurement noise of standard deviation `sigma`, these are the square roots
    of the diagonal of σ²(SᵀS)⁻¹. S has the central differences of the first output by each
    parameter of `true`.
    """

    def output(name: str, shift: float) -> NDArray[np.float64]:
        moved = {**true, name: true[name] + shift}
        return np.asarray(simulate(model, inputs, moved, times=times).channels[0].values)

    steps = {name: RELATIVE_STEP * max(abs(value), 1e-6) for name, value in true.items()}
    columns = [
        (output(name, step) - output(name, -step)) / (2 * step) for name, step in steps.items()
    ]
    sensitivity = np.stack(columns, axis=1)
    covariance = sigma**2 * np.linalg.inv(sensitivity.T @ sensitivity)
    return dict(zip(true, np.sqrt(np.diag(covariance)).tolist(), strict=True))
