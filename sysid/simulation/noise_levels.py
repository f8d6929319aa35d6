"""Choices of the sizes of noise inside the plant, from which a likelihood is searched."""

from collections.abc import Mapping
from itertools import product

import numpy as np

from sysid.core.types import FloatArray
from sysid.models.kalman_filter import is_noise_parameter
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit

_LEVELS = (0.3, 0.45, 0.6)  # of the range of each size
_MOST_COMBINED = 4  # sizes whose levels are combined; of more, all have the same level


def add_noise_levels(problem: Problem, plant: Mapping[str, float]) -> FloatArray:
    """Add sizes of noise to values of the other free parameters: individuals (P, D)."""
    rows = [i for i, name in enumerate(problem.free_names) if is_noise_parameter(name)]
    is_few = len(rows) <= _MOST_COMBINED
    levels = np.array(list(product(_LEVELS, repeat=len(rows) if is_few else 1)))
    points = np.full((len(levels), len(problem.free_names)), 0.5)
    points[:, rows] = levels
    theta = from_unit(problem.evaluator, points)
    for i, name in enumerate(problem.free_names):
        if i not in rows:
            theta[:, i] = plant[name]
    return theta
