"""Conversion of parameters to and from the unit interval."""

import numpy as np

from sysid.core.types import BoolArray, FloatArray
from sysid.kernels.borrowing import compile_borrowing
from sysid.simulation.evaluator import Evaluator


@compile_borrowing
def from_unit(evaluator: Evaluator, places: FloatArray) -> FloatArray:
    """Convert positions in [0, 1] to physical values: (P, D) → (P, D)."""
    theta = np.empty(places.shape)
    for d in range(places.shape[1]):
        lower, upper = evaluator.lower[d], evaluator.upper[d]
        for p in range(places.shape[0]):
            if evaluator.is_log[d]:
                value = lower * np.exp(places[p, d] * np.log(upper / lower))
            else:
                value = lower + (upper - lower) * places[p, d]
            theta[p, d] = min(max(value, lower), upper)
    return theta


@compile_borrowing
def to_unit(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Convert physical values to positions, the inverse of `from_unit`; clipped to the bounds."""
    places = np.empty(theta.shape)
    for d in range(theta.shape[1]):
        lower, upper = evaluator.lower[d], evaluator.upper[d]
        for p in range(theta.shape[0]):
            value = min(max(theta[p, d], lower), upper)
            if evaluator.is_log[d]:
                places[p, d] = np.log(value / lower) / np.log(upper / lower)
            else:
                places[p, d] = (value - lower) / (upper - lower)
    return places


AT_BOUND = 1e-6
"""Share of the interval: an estimate nearer to a bound counts as at the bound."""


def is_at_bounds(places: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Return which positions in [0, 1] are at the lower end, and which at the upper one."""
    return np.asarray(places < AT_BOUND), np.asarray(places > 1.0 - AT_BOUND)
