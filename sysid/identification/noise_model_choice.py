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

The noise model ``auto``: squares or generalised least squares, by whether the model forgets.

Coloured residuals are noise or dynamics that the model lacks, and they do not tell which. In a
model that forgets (`sysid.identification.noise_model_choice`) squares are the better criterion for
a free run: whitened ones shift what is missing to low frequencies. In one that does not, whatever
disturbs the states stays in all later outputs, so that residuals drift also where the dynamics are
right, and squares weigh the drift. Simulated plants of 17 kinds bear it out (decision 26, as
amended).

The correlation time has to be known, too: where a record is not five times as long, generalised
least squares was no better than squares.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sysid.core.settings import NoiseModel
from sysid.core.types import FloatArray
from sysid.core.units import format_unit
from sysid.identification.generalised_least_squares import (
    GeneralisedEstimate,
    find_coloured_outputs,
)
from sysid.identification.integration_step import warn_integration_step
from sysid.kernels.layout import ExperimentLayout
from sysid.residuals.autocorrelation import ROUNDING_SHARE
from sysid.residuals.coloured import iterate_parts
from sysid.simulation.evaluator import predict_population
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis

_CHANGE_SIZE = 1e-3  # of the outputs' size: the change that is looked at
_CHANGE_TOLERANCE = 3.0  # factor by which it may be another
MAX_TRIES = 8
"""Simulations for each state, at most."""
_MOVE_FACTOR = 1e4  # where a move shows nothing: states have units of their own
_LASTING_SHARE = 0.05  # of the largest change
_LATE_PART = 0.75  # of a record: behind it the change is looked for


def find_integrating_outputs(problem: Problem, theta: FloatArray) -> set[str]:
    """Outputs in which a shift by the start of some state lasts up to the end of a record.

    Parameters
    ----------
    theta : FloatArray, shape (D,)
    """
    names: set[str] = set()
    before = problem.predict(theta[None])[0]
    for state in range(len(problem.model.states)):
        change = _perturb_state(problem, theta, before, state)
        if change is not None:
            names |= _find_lasting_changes(problem, change)
    return names


def _perturb_state(
    problem: Problem, theta: FloatArray, before: FloatArray, state: int
) -> FloatArray | None:
    """What a move of a state's start makes of the weighted outputs (M,); None: nothing."""
    size = problem.output_scale
    move, weight = _CHANGE_SIZE * size, problem.evaluator.weight
    for _ in range(MAX_TRIES):
        with np.errstate(all="ignore"):  # what diverges from where it is moved to
            change = weight * (_simulate_shifted_start(problem, theta, state, move) - before)
            largest = float(np.max(np.abs(change)))
        if not np.isfinite(largest):
            move /= _MOVE_FACTOR
        elif largest <= ROUNDING_SHARE * size:
            move *= _MOVE_FACTOR
        elif (
            size * _CHANGE_SIZE / _CHANGE_TOLERANCE
            <= largest
            <= size * _CHANGE_SIZE * _CHANGE_TOLERANCE
        ):
            return np.asarray(change)
        else:
            move *= size * _CHANGE_SIZE / largest
    return np.asarray(change) if np.isfinite(largest) and largest > ROUNDING_SHARE * size else None


def _simulate_shifted_start(
    problem: Problem, theta: FloatArray, state: int, move: float
) -> FloatArray:
    """Outputs (M,) where a state starts elsewhere, in every experiment."""
    evaluator, layout = problem.evaluator, ExperimentLayout.from_model(problem.model)
    floats, template, values = evaluator.floats.copy(), evaluator.template.copy(), theta.copy()
    for experiment, (ints, first, _) in zip(
        problem.experiments, evaluator.offsets.tolist(), strict=True
    ):
        start = experiment.starts[state]
        if start.row >= 0:
            template[start.row] += move
            values[evaluator.free_rows == start.row] += move
        else:
            floats[first + layout.locate_initial(state)] += move
            first_value = first + int(evaluator.ints[ints + layout.locate_state(state, "given")])
            floats[first_value : first_value + start.first_values.size] += move
    elsewhere = evaluator._replace(floats=floats, template=template)
    return np.asarray(predict_population(elsewhere, values[None])[0])


def _find_lasting_changes(problem: Problem, change: FloatArray) -> set[str]:
    """Outputs shifted one way at the end of every experiment, beside its largest change of all."""
    lasts: dict[str, bool] = {}
    weights = problem.split_by_output(problem.evaluator.weight)
    for changes, weight in zip(problem.split_by_output(change), weights, strict=True):
        scored = {name: values[weight[name] > 0] for name, values in changes.items()}
        largest = max(float(np.max(np.abs(values), initial=0.0)) for values in scored.values())
        for name, values in scored.items():
            late = values[int(_LATE_PART * values.size) :]
            if late.size:
                is_left = max(np.min(late), np.min(-late)) > _LASTING_SHARE * largest
                lasts[name] = lasts.get(name, True) and bool(is_left)
    return {name for name, is_left in lasts.items() if is_left}


_MIN_RECORD_TIMES = 5.0  # correlation times that a record lasts at least


def is_ar1_indicated(
    problem: Problem,
    theta: FloatArray,
    analysis: Analysis,
    is_late: Callable[[], bool] | None = None,
    max_simulations: int | None = None,
) -> bool:
    """Whether residuals of least squares at theta (D,) are coloured and none of it is forgotten.

    The analysis of those estimates tells the colour: no more is looked at where it is white. What
    comes of too long a step of the integration is no noise. `most` are the simulations that the
    time leaves: where the look may take more there is none.
    """
    uncertainty = analysis.uncertainty
    is_free = problem.prediction == "simulation" and problem.loss.kind == "squares"
    if not is_free or uncertainty is None or uncertainty.noise_colour == "white":
        return False
    if max_simulations is not None and max_simulations < 2 + MAX_TRIES * len(problem.model.states):
        return False
    coloured = find_coloured_outputs(problem, theta)
    if not coloured or not coloured <= find_integrating_outputs(problem, theta):
        return False
    simulated = problem.predict(theta[None])[0]
    return not warn_integration_step(problem, theta, analysis.estimates, simulated, is_late)


def confirm_noise_model(
    problem: Problem, theta: FloatArray, estimate: GeneralisedEstimate
) -> GeneralisedEstimate:
    """What was found under first-order noise, or squares again where it is not known well."""
    longest: dict[str, float] = {}
    for part in iterate_parts(problem):
        span = float(part.times[-1] - part.times[0])
        longest[part.output] = max(span, longest.get(part.output, 0.0))
    times = estimate.correlation_times
    squares = GeneralisedEstimate(theta, {}, estimate.evaluations, True)
    if not estimate.is_complete or not any(times.values()):
        return squares
    slow = {name: time for name, time in times.items() if _MIN_RECORD_TIMES * time > longest[name]}
    return (
        squares._replace(unresolved_times=slow)
        if slow
        else estimate._replace(least_squares_theta=theta)
    )


def resolve_noise_model(problem: Problem, noise: GeneralisedEstimate) -> Problem:
    """The problem with the noise model that its estimates are of, in place of ``auto``."""
    if problem.loss.noise_model != "auto":
        return problem
    noise_model: NoiseModel = "ar1" if any(noise.correlation_times.values()) else "white"
    loss = replace(problem.loss, noise_model=noise_model)
    return replace(problem, settings=replace(problem.settings, loss=loss))


def explain_noise_model_choice(problem: Problem, noise: GeneralisedEstimate) -> tuple[str, ...]:
    """Why there is a noise model that nobody asked for, and what squares gave; or why not."""
    if noise.unresolved_times:
        times = ", ".join(f"{name} {time:.3g} s" for name, time in noise.unresolved_times.items())
        return (
            "noise_model auto keeps least squares, although the residuals drift and the model "
            f"integrates. With ar1 the noise would have a correlation time of {times}. "
            f"The record is not {_MIN_RECORD_TIMES:g} times as long.",
        )
    if noise.least_squares_theta is None:
        return ()
    squares = ", ".join(
        f"{parameter.name} = {value:.4g}{format_unit(parameter.unit)}"
        for parameter, value in zip(
            problem.free_parameters, noise.least_squares_theta.tolist(), strict=True
        )
    )
    metrics = problem.evaluate_metrics(np.asarray(noise.least_squares_theta))
    unit = format_unit(metrics.unit)
    return (
        "noise_model auto selected ar1: the least-squares residuals are autocorrelated and the "
        "model integrates, as a drive or a tank does. Plain least squares gave "
        f"{squares}, RMS {metrics.rms:.4g}{unit}. "
        "To get these, use loss: {noise_model: white}",
    )
