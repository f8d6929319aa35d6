"""Sums of parameters that can move along a line without any change of the output.

An offset beside a friction that differs with the direction is such a case: with o + Fp and o - Fn
as they are, every simulation is the same. Small differences do not always show it: where a carriage
sticks and breaks away the output answers to the last digit, and the singular value is far from
nil. So the least certain directions are rounded to simple ratios, and the model is simulated a good
way off along them. Only what changes nothing there counts.
"""

import numpy as np

from sysid.core.types import FloatArray
from sysid.simulation.problem import Problem

_LEAST_SHARE = 0.02  # of a direction (squared) from which a parameter may belong to it
_UNCERTAIN_RATIO = 0.1  # of the largest singular value: directions above are known well enough
_RATIO_DENOMINATOR = 2  # ratios are rounded to halves
_MOVE_SHARE = 0.02  # of the range, for the parameter that moves most
_SAME_TOLERANCE = 1e-10  # of the output's size: rounding


def find_translations(
    problem: Problem,
    theta: FloatArray,
    columns: FloatArray,
    scale: FloatArray,
    most: int | None = None,
) -> tuple[FloatArray, int]:
    """Directions along which the output stays, and the simulations this took.

    Parameters
    ----------
    theta : FloatArray, shape (D,)
        The estimate.
    columns : FloatArray, shape (n, D)
        Sensitivities over the places in [0, 1].
    scale : FloatArray, shape (D,)
        ∂θ/∂p of the places p.
    most : int or None
        Simulations that may be run; directions beyond are not looked at.

    Returns
    -------
    FloatArray, shape (k, D)
        In the parameters' units; k = 0 where there is none.
    """
    singular, rows = np.linalg.svd(columns, full_matrices=False)[1:]
    found = []
    evaluations = 0
    for row in rows[singular < _UNCERTAIN_RATIO * singular[0]]:
        direction = _round_direction(row, scale)
        if not _has_common_unit(problem, direction) or (
            most is not None and evaluations + 2 > most
        ):
            continue
        evaluations += 2
        if _is_invariant(problem, theta, direction, scale):
            found.append(direction)
    return np.array(found).reshape(len(found), theta.size), evaluations


def _round_direction(row: FloatArray, scale: FloatArray) -> FloatArray:
    """The direction in the parameters' units, its largest entry 1 and the others simple ratios."""
    physical = np.where(row**2 > _LEAST_SHARE, row * scale, 0.0)
    largest = np.argmax(np.abs(physical))
    return np.asarray(
        np.round(_RATIO_DENOMINATOR * physical / physical[largest]) / _RATIO_DENOMINATOR
    )


def _has_common_unit(problem: Problem, direction: FloatArray) -> bool:
    """Whether it moves several parameters, and all are of one unit."""
    moved = np.flatnonzero(direction)
    return moved.size > 1 and len({problem.free_parameters[i].unit for i in moved}) == 1


def _is_invariant(
    problem: Problem, theta: FloatArray, direction: FloatArray, scale: FloatArray
) -> bool:
    """Whether the output is the same a good way off, on the side that lies inside the bounds."""
    step = _MOVE_SHARE / np.max(np.abs(direction / scale)) * direction
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    room = [
        np.min(np.where(s < 0, theta - lower, upper - theta)[s != 0] / np.abs(s[s != 0]))
        for s in (step, -step)
    ]
    side = int(np.argmax(room))
    moved = theta + min(1.0, room[side]) * (step if side == 0 else -step)
    if min(1.0, room[side]) < 0.1:
        return False
    here, there = problem.predict(np.vstack([theta, moved]))
    with np.errstate(invalid="ignore"):
        return bool(np.max(np.abs(there - here)) <= _SAME_TOLERANCE * np.max(np.abs(here)))
