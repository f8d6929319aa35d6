"""Choose the noise model for ``auto``: least squares, or generalised least squares (ar1).

Coloured residuals are noise or missing dynamics, and the residuals alone do not show which. The
choice depends on whether the model integrates, that is, whether initial errors persist.

The outputs of a first-order lag or a damped oscillator do not depend on states of long ago. Those
of an integrator do for ever: a drive's position, a tank's level, any system with a pole at 0. A
short disturbance stays in all later outputs, so the residuals of a free run drift even if the
dynamics are right. Least squares weighs this drift, so generalised least squares is better there.
In a model that does not integrate, least squares is the better criterion for a free run: whitened
residuals shift missing dynamics to low frequencies. Simulated plants of 17 kinds confirm this
(decision 26, as amended).

The test perturbs the start of one state after the other and simulates again. An output integrates
if more than a twentieth of the largest change is left throughout the last quarter of the record,
with one sign. A first-order lag passes too if its time constant exceeds a third of the record. All
experiments must agree, because one of them may be too short to forget a lag of seconds. The phase
of a self-sustained oscillation, and chaos, persist as well, but that is no drift.

The correlation time must be resolved as well. Where a record is not five times as long,
generalised least squares was no better than least squares.
"""

from dataclasses import replace

import numpy as np

from sysid.core.settings import NoiseModel
from sysid.core.types import FloatArray
from sysid.core.units import format_unit
from sysid.identification.generalised_least_squares import (
    GeneralisedEstimate,
    find_coloured_outputs,
)
from sysid.kernels.layout import ExperimentLayout
from sysid.residuals.autocorrelation import ROUNDING_SHARE
from sysid.residuals.coloured import iterate_parts
from sysid.simulation.evaluator import predict_population
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis

_CHANGE_SIZE = 1e-3  # of the outputs' size: change that a perturbation should cause
_CHANGE_TOLERANCE = 3.0  # factor by which it may differ
MAX_TRIES = 8
"""Most simulations for each state."""
_MOVE_FACTOR = 1e4  # growth of a perturbation without effect: states have different units
_LASTING_SHARE = 0.05  # of the largest change
_LATE_PART = 0.75  # of a record: the change is measured after it


def find_integrating_outputs(problem: Problem, theta: FloatArray) -> set[str]:
    """Find outputs in which a shifted start of some state persists to the end of the record.

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
    """Change of the weighted outputs (M,) by a shifted start of a state; None: no change."""
    size = problem.output_scale
    move, weight = _CHANGE_SIZE * size, problem.evaluator.weight
    for _ in range(MAX_TRIES):
        with np.errstate(all="ignore"):  # a shifted start may diverge
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
    """Simulate outputs (M,) with the start of a state shifted in every experiment."""
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
    """Find outputs with one sign of change at the end of every experiment."""
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


_MIN_RECORD_TIMES = 5.0  # least length of a record, in correlation times


def is_ar1_indicated(
    problem: Problem,
    theta: FloatArray,
    analysis: Analysis,
    max_simulations: int | None = None,
) -> bool:
    """Whether least-squares residuals at theta (D,) are coloured and the model integrates.

    The analysis of the estimates gives the colour; white residuals end the test. If the test may
    need more than `max_simulations`, the answer is no.
    """
    uncertainty = analysis.uncertainty
    is_free = problem.prediction == "simulation" and problem.loss.kind == "squares"
    if not is_free or uncertainty is None or uncertainty.noise_colour == "white":
        return False
    if max_simulations is not None and max_simulations < 2 + MAX_TRIES * len(problem.model.states):
        return False
    coloured = find_coloured_outputs(problem, theta)
    return bool(coloured) and coloured <= find_integrating_outputs(problem, theta)


def confirm_noise_model(
    problem: Problem, theta: FloatArray, estimate: GeneralisedEstimate
) -> GeneralisedEstimate:
    """Return the estimate under first-order noise, or least squares if it is not resolved."""
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
    """Replace the noise model ``auto`` of a problem by the one that was selected."""
    if problem.loss.noise_model != "auto":
        return problem
    noise_model: NoiseModel = "ar1" if any(noise.correlation_times.values()) else "white"
    loss = replace(problem.loss, noise_model=noise_model)
    return replace(problem, settings=replace(problem.settings, loss=loss))


def explain_noise_model_choice(problem: Problem, noise: GeneralisedEstimate) -> tuple[str, ...]:
    """Explain why ``auto`` selected a noise model and what least squares gave; or why not."""
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
