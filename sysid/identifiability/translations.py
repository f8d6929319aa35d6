"""Translations: lines along which parameters can move without any change of the output.

An example is an offset together with direction-dependent friction. All parameters with the same
o + Fp and o - Fn give the same simulation. Small differences do not always show it. If a carriage
sticks and breaks away, the output reacts to the last digit, and the singular value is not near 0.

So the least certain directions are rounded to simple ratios. The model is then simulated at some
distance along them. A direction counts only if the output stays the same there.
"""

import numpy as np

from sysid.core.linear_algebra import TruncatedSvd
from sysid.core.types import FloatArray
from sysid.simulation.problem import Problem

_MIN_SHARE = 0.02  # of a direction (squared) from which a parameter may belong to it
_UNCERTAIN_RATIO = 0.1  # of the largest singular value: directions above are certain enough
_RATIO_DENOMINATOR = 2  # ratios are rounded to halves
_MOVE_SHARE = 0.02  # of the range, for the parameter that moves most
_SAME_TOLERANCE = 1e-10  # of the output's size: rounding


def find_translations(
    problem: Problem,
    theta: FloatArray,
    decomposition: TruncatedSvd,
    scale: FloatArray,
    most: int | None = None,
) -> tuple[FloatArray, int]:
    """Find directions along which the output is constant, and count the simulations.

    Parameters
    ----------
    theta : FloatArray, shape (D,)
        The estimate.
    decomposition : TruncatedSvd
        Of the sensitivities (n, D) to the point in [0, 1].
    scale : FloatArray, shape (D,)
        ∂θ/∂p at the point p.
    most : int or None
        Limit on the simulations; directions beyond are not tested.

    Returns
    -------
    FloatArray, shape (k, D)
        In the parameters' units; k = 0: there is none.
    """
    _, singular, rows, _ = decomposition
    if not problem.share("parameters of one unit", lambda: _have_common_units(problem)):
        return np.zeros((0, theta.size)), 0
    directions = []
    evaluations = 0
    for row in rows[singular < _UNCERTAIN_RATIO * singular[0]]:
        direction = _round_direction(row, scale)
        if not _has_common_unit(problem, direction) or (
            most is not None and evaluations + 2 > most
        ):
            continue
        evaluations += 2
        if _is_invariant(problem, theta, direction, scale):
            directions.append(direction)
    return np.array(directions).reshape(len(directions), theta.size), evaluations


def _round_direction(row: FloatArray, scale: FloatArray) -> FloatArray:
    """Round a direction in the parameters' units: largest entry 1, the others simple ratios."""
    physical = np.where(row**2 > _MIN_SHARE, row * scale, 0.0)
    largest = np.argmax(np.abs(physical))
    return np.asarray(
        np.round(_RATIO_DENOMINATOR * physical / physical[largest]) / _RATIO_DENOMINATOR
    )


def _have_common_units(problem: Problem) -> bool:
    """Return whether any two free parameters have the same unit."""
    units = [parameter.unit for parameter in problem.free_parameters]
    return len(set(units)) < len(units)


def _has_common_unit(problem: Problem, direction: FloatArray) -> bool:
    """Return whether a direction moves several parameters of the same unit."""
    moved = np.flatnonzero(direction)
    return moved.size > 1 and len({problem.free_parameters[i].unit for i in moved}) == 1


def _is_invariant(
    problem: Problem, theta: FloatArray, direction: FloatArray, scale: FloatArray
) -> bool:
    """Return whether the output stays the same at a distance, on the side inside the bounds."""
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
    original, translated = problem.predict(np.vstack([theta, moved]))
    with np.errstate(invalid="ignore"):
        return bool(
            np.max(np.abs(translated - original)) <= _SAME_TOLERANCE * np.max(np.abs(original))
        )
