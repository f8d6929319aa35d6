"""Parameters to and from the unit interval."""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import BoolArray, FloatArray
from sysid.simulation.evaluator import Evaluator


@jit_compile
def from_unit(evaluator: Evaluator, places: FloatArray) -> FloatArray:
    """Physical values of places in [0, 1]: (P, D) → (P, D)."""
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


@jit_compile
def to_unit(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Places of physical values, the inverse of `from_unit`; values out of bounds go to the bound."""
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
"""Of the interval: an estimate nearer to its end than that lies at its bound."""


def is_at_bounds(places: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Whether each place in [0, 1] lies at the lower end, and whether at the upper one."""
    return np.asarray(places < AT_BOUND), np.asarray(places > 1.0 - AT_BOUND)
