"""Slopes of the outputs in starts that are assumed: numbers, measured values, a rest.

An assumed start may be wrong. Then the estimates compensate for it, and their standard errors do
not show it. These slopes, beside the sensitivities of the parameters, tell what it would explain.
"""

from dataclasses import replace

import numpy as np

from sysid.core.types import FloatArray
from sysid.models.model import EstimatedInitial, MeasuredInitial, name_initial_state
from sysid.models.sections import OPEN_START
from sysid.simulation.fit_metrics import compute_mean
from sysid.simulation.problem import Problem
from sysid.simulation.start_values import list_starts

_FIRST_STEP = 1e-9  # of the start, or in its unit: first trial of the step of its slope
_NOTABLE_STEP = 0.1  # of the noise: a step that moves the outputs less is too small
_MAX_GROWTH, _MAX_TRIALS = 1e6, 5  # of the step


def list_assumed_starts(problem: Problem) -> list[str]:
    """List the states whose starts are not estimated."""
    model = problem.untied_model
    pairs = zip(model.states, model.initial, strict=True)
    return [state.name for state, start in pairs if not isinstance(start, EstimatedInitial)]


def compute_start_slopes(
    problem: Problem, theta: FloatArray, state: str, noise: float
) -> FloatArray:
    """Compute the slopes (n, E) of the weighted outputs in a state's start; 0 if undefined.

    The step is the one that moves the outputs by about the noise, in whatever unit the state has.
    """
    weight, rows = problem.evaluator.weight[problem.scored_rows], problem.scored_rows
    names = [name_initial_state(state, e) for e in range(len(problem.experiments))]
    # A start at a measured value differs from run to run of a sweep, and any other does not.
    depends = any(isinstance(start, MeasuredInitial) for start in problem.model.initial)
    freed = (
        _free_start(problem, state)
        if depends
        else problem.share(f"free start of {state}", lambda: _free_start(problem, state))
    )
    values = {**list_starts(problem, theta), **dict(zip(problem.free_names, theta, strict=True))}
    point = np.array([values[name] for name in freed.free_names])
    is_start = np.array([name in names for name in freed.free_names])

    def simulate(*steps: float) -> FloatArray:
        points = np.repeat(point[None], len(steps), axis=0)
        points[:, is_start] += np.array(steps)[:, None]
        return np.asarray(weight * freed.predict(points)[:, rows])

    slopes = np.zeros((rows.size, len(names)))
    step = _FIRST_STEP * max(*(abs(values[name]) for name in names), 1.0)
    with np.errstate(all="ignore"):
        output, above, below = simulate(0.0, step, -step)
        for _ in range(_MAX_TRIALS):
            move = float(np.sqrt(compute_mean((above - output) ** 2)))
            if not move < _NOTABLE_STEP * noise:
                break
            step *= noise / max(move, noise / _MAX_GROWTH)
            above, below = simulate(step, -step)
        slope = (above - below) / (2.0 * step)
    if np.all(np.isfinite(slope)):
        counts = [sum(one.positions.size for one in e.outputs) for e in problem.experiments]
        experiments = np.repeat(np.arange(len(counts)), counts)[rows]
        slopes[np.arange(rows.size), experiments] = slope
    return slopes


def _free_start(problem: Problem, state: str) -> Problem:
    """Make a problem in which the starts of a state are parameters, beside those that are."""
    model = problem.untied_model
    initial = tuple(
        OPEN_START if one.name == state else start
        for one, start in zip(model.states, model.initial, strict=True)
    )
    return problem.rebuild(
        model=replace(model, initial=initial), initial=None, weights=problem.output_weights
    )
