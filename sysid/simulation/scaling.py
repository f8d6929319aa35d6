"""Conversion of parameters to and from the unit interval."""

from collections.abc import Sequence
from typing import get_args

import numpy as np

from sysid.core.types import BoolArray, FloatArray
from sysid.kernels.borrowing import compile_borrowing
from sysid.models.parameters import BoundSide, Parameter
from sysid.simulation.evaluator import Evaluator


@compile_borrowing
def from_unit(evaluator: Evaluator, points: FloatArray) -> FloatArray:
    """Convert points in [0, 1] to physical values: (P, D) → (P, D)."""
    theta = np.empty(points.shape)
    for d in range(points.shape[1]):
        lower, upper = evaluator.lower[d], evaluator.upper[d]
        for p in range(points.shape[0]):
            if evaluator.is_log[d]:
                value = lower * np.exp(points[p, d] * np.log(upper / lower))
            else:
                value = lower + (upper - lower) * points[p, d]
            theta[p, d] = min(max(value, lower), upper)
    return theta


@compile_borrowing
def to_unit(evaluator: Evaluator, theta: FloatArray) -> FloatArray:
    """Convert physical values to points, the inverse of `from_unit`; clipped to the bounds."""
    points = np.empty(theta.shape)
    for d in range(theta.shape[1]):
        lower, upper = evaluator.lower[d], evaluator.upper[d]
        for p in range(theta.shape[0]):
            value = min(max(theta[p, d], lower), upper)
            if evaluator.is_log[d]:
                points[p, d] = np.log(value / lower) / np.log(upper / lower)
            else:
                points[p, d] = (value - lower) / (upper - lower)
    return points


AT_BOUND = 1e-6
"""Share of the interval: an estimate nearer to a bound counts as at the bound."""


def is_at_limits(parameters: Sequence[Parameter], point: FloatArray) -> BoolArray:
    """Return which coordinates (D,) in [0, 1] are at a bound that is a physical limit."""
    is_at = np.array(is_at_bounds(point))
    return np.asarray(np.any(is_at & find_physical_bounds(parameters), axis=0))


def find_physical_bounds(parameters: Sequence[Parameter]) -> BoolArray:
    """Find which bounds (2, D), the lower and the upper ones, are physical limits."""
    sides = get_args(BoundSide)
    return np.array([[one.is_physical(side) for one in parameters] for side in sides])


def is_at_bounds(points: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Return which coordinates in [0, 1] are at the lower end, and which at the upper one."""
    return np.asarray(points < AT_BOUND), np.asarray(points > 1.0 - AT_BOUND)
