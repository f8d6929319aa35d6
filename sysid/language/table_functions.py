"""Lookup tables: ``table(u, [x1, …], [y1, …])`` is linear, ``pchip`` a monotone cubic.

In a tree a table is a call with its argument, all x and all y. The x are increasing numbers, the
y have no signals. Outside the points both have the value at the nearest end.
"""

from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray
from sysid.language.tree import Expression, FunctionCall, Number

TABLE_FUNCTIONS = ("table", "pchip")

MAX_POINTS = 128
"""Most points of a table; a kernel has instructions for each."""


class LookupTable(NamedTuple):
    """Argument and points of a table."""

    argument: Expression
    x: tuple[float, ...]
    y: tuple[Expression, ...]


def split_table(call: FunctionCall) -> LookupTable:
    """Split a call of a table into its argument and its points."""
    argument, *points = call.arguments
    count = len(points) // 2
    positions = tuple(node.value for node in points[:count] if isinstance(node, Number))
    return LookupTable(argument, positions, tuple(points[count:]))


def evaluate_table(function: str, argument: FloatArray, *points: FloatArray) -> FloatArray:
    """Evaluate a table at values of its argument (any shape); ``nan`` if a point is not finite."""
    x, y = np.reshape(points, (2, -1))
    if function == "table":
        return np.asarray(np.interp(argument, x, y))
    from scipy.interpolate import PchipInterpolator  # slow to load, rarely needed

    if not np.all(np.isfinite(y)):
        return np.full(np.shape(argument), np.nan)
    return np.asarray(PchipInterpolator(x, y)(np.clip(argument, x[0], x[-1])))
