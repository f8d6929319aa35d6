"""Whether a model forgets where it began.

The outputs of a lag of some time constant, or of a damped oscillator, do not depend on states of
long ago. Those of an integrator do for ever: a drive's position, a tank's level, whatever has a
pole at 0. In these a disturbance of a moment stays in all later outputs, and the error of a free
run drifts by its nature.

It is looked at where the model is: the start of one state after the other is moved a little, and
the free run made again. A model remembers where all through the last quarter of a record more than
a twentieth is left of the largest change, with one sign: a first-order lag with a time constant of
more than a third of the record, too. Of several experiments all have to say so: a lag of seconds is
forgotten, though one of them may end before. The phase of an oscillation that sustains itself, and
chaos, are not forgotten either, but that is no drift.
"""

import numpy as np

from sysid.kernels.evaluation import population_predictions
from sysid.kernels.layout import Layout
from sysid.lagged_sums import ROUNDING
from sysid.problem import Problem
from sysid.types import FloatArray

_MOVE = 1e-3  # of the outputs' size: the change that is looked at
_NEAR = 3.0  # factor by which it may be another
TRIES = 8
"""Simulations for each state, at most."""
_FARTHER = 1e4  # where a move shows nothing: states have units of their own
_LEFT = 0.05  # of the largest change
_LATE = 0.75  # of a record: behind it the change is looked for


def remembering(problem: Problem, theta: FloatArray) -> set[str]:
    """Outputs in which a shift by the start of some state lasts up to the end of a record.

    Parameters
    ----------
    theta : FloatArray, shape (D,)
    """
    names: set[str] = set()
    before = problem.predictions(theta[None])[0]
    for state in range(len(problem.model.states)):
        change = _change(problem, theta, before, state)
        if change is not None:
            names |= _lasting(problem, change)
    return names


def _change(
    problem: Problem, theta: FloatArray, before: FloatArray, state: int
) -> FloatArray | None:
    """What a move of a state's start makes of the weighted outputs (M,); None: nothing."""
    size = problem.output_scale
    move, weight = _MOVE * size, problem.evaluator.weight
    for _ in range(TRIES):
        with np.errstate(all="ignore"):  # what diverges from where it is moved to
            change = weight * (_moved(problem, theta, state, move) - before)
            largest = float(np.max(np.abs(change)))
        if not np.isfinite(largest):
            move /= _FARTHER
        elif largest <= ROUNDING * size:
            move *= _FARTHER
        elif size * _MOVE / _NEAR <= largest <= size * _MOVE * _NEAR:
            return np.asarray(change)
        else:
            move *= size * _MOVE / largest
    return np.asarray(change) if np.isfinite(largest) and largest > ROUNDING * size else None


def _moved(problem: Problem, theta: FloatArray, state: int, move: float) -> FloatArray:
    """Outputs (M,) where a state starts elsewhere, in every experiment."""
    evaluator, layout = problem.evaluator, Layout.of(problem.model)
    floats, template, values = evaluator.floats.copy(), evaluator.template.copy(), theta.copy()
    for laid, (ints, first, _) in zip(problem.experiments, evaluator.plans.tolist(), strict=True):
        start = laid.starts[state]
        if start.row >= 0:
            template[start.row] += move
            values[evaluator.rows == start.row] += move
        else:
            floats[first + layout.initial(state)] += move
            given = first + int(evaluator.ints[ints + layout.state(state, "given")])
            floats[given : given + start.given.size] += move
    elsewhere = evaluator._replace(floats=floats, template=template)
    return np.asarray(population_predictions(elsewhere, values[None])[0])


def _lasting(problem: Problem, change: FloatArray) -> set[str]:
    """Outputs shifted one way at the end of every experiment, beside its largest change of all."""
    lasts: dict[str, bool] = {}
    weights = problem.split(problem.evaluator.weight)
    for changes, weight in zip(problem.split(change), weights, strict=True):
        seen = {name: one[weight[name] > 0] for name, one in changes.items()}
        largest = max(float(np.max(np.abs(one), initial=0.0)) for one in seen.values())
        for name, one in seen.items():
            late = one[int(_LATE * one.size) :]
            if late.size:
                is_left = max(np.min(late), np.min(-late)) > _LEFT * largest
                lasts[name] = lasts.get(name, True) and bool(is_left)
    return {name for name, is_left in lasts.items() if is_left}
