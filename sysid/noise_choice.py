"""The noise model ``auto``: squares or generalised least squares, by whether the model forgets.

Coloured residuals are noise or dynamics that the model lacks, and they do not tell which. In a
model that forgets (`sysid.forgetting`) squares are the better criterion for a free run: whitened
ones shift what is missing to low frequencies. In one that does not, whatever disturbs the states
stays in all later outputs, so that residuals drift also where the dynamics are right, and squares
weigh the drift. Simulated plants of 17 kinds bear it out (decision 26, as amended).

The correlation time has to be known, too: where a record is not five times as long, generalised
least squares was no better than squares.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sysid.forgetting import TRIES, remembering
from sysid.noise_model import Generalised, coloured_outputs
from sysid.problem import Problem
from sysid.serial import parts
from sysid.step_check import step_notes
from sysid.types import FloatArray
from sysid.uncertainty import Analysis

_TIMES = 5.0  # correlation times that a record lasts at least


def speaks_for_ar1(
    problem: Problem, theta: FloatArray, analysis: Analysis,
    is_late: Callable[[], bool] | None = None, most: int | None = None,
) -> bool:  # fmt: skip
    """Whether residuals of least squares at theta (D,) are coloured and none of it is forgotten.

    The analysis of those estimates tells the colour: no more is looked at where it is white. What
    comes of too long a step of the integration is no noise. `most` are the simulations that the
    time leaves: where the look may take more there is none.
    """
    known = analysis.uncertainty
    is_free = problem.prediction == "simulation" and problem.loss.kind == "squares"
    if not is_free or known is None or known.noise_colour == "white":
        return False
    if most is not None and most < 2 + TRIES * len(problem.model.states):
        return False
    coloured = coloured_outputs(problem, theta)
    if not coloured or not coloured <= remembering(problem, theta):
        return False
    simulated = problem.predictions(theta[None])[0]
    return not step_notes(problem, theta, analysis.estimates, simulated, is_late)


def settled(problem: Problem, theta: FloatArray, found: Generalised) -> Generalised:
    """What was found under first-order noise, or squares again where it is not known well."""
    longest: dict[str, float] = {}
    for one in parts(problem):
        span = float(one.times[-1] - one.times[0])
        longest[one.output] = max(span, longest.get(one.output, 0.0))
    times = found.correlation_times
    squares = Generalised(theta, {}, found.evaluations, True)
    if not found.is_complete or not any(times.values()):
        return squares
    slow = {name: time for name, time in times.items() if _TIMES * time > longest[name]}
    return squares._replace(too_slow=slow) if slow else found._replace(instead_of=theta)


def decided(problem: Problem, noise: Generalised) -> Problem:
    """The problem with the noise model that its estimates are of, in place of ``auto``."""
    if problem.loss.noise_model != "auto":
        return problem
    model, records, parameters, prediction, loss, *others = problem.arguments
    loss = replace(loss, noise_model="ar1" if any(noise.correlation_times.values()) else "white")
    return replace(problem, arguments=(model, records, parameters, prediction, loss, *others))


def choice_notes(problem: Problem, noise: Generalised) -> tuple[str, ...]:
    """Why there is a noise model that nobody asked for, and what squares gave; or why not."""
    if noise.too_slow:
        found = ", ".join(f"{name} {time:.3g} s" for name, time in noise.too_slow.items())
        return (
            "noise_model auto keeps squares, though the residuals drift and the model does not "
            "forget where it began: ar1 would have a correlation time of "
            f"{found}, and the record is not {_TIMES:g} times as long",
        )
    if noise.instead_of is None:
        return ()
    squares = ", ".join(
        f"{one.name} = {value:.4g}{'' if one.unit == '1' else f' {one.unit}'}"
        for one, value in zip(problem.space, noise.instead_of.tolist(), strict=True)
    )
    metrics = problem.metrics(np.asarray(noise.instead_of))
    unit = "" if metrics.unit == "1" else f" {metrics.unit}"
    return (
        "noise_model auto chose ar1: the residuals of squares are not white, and the model does "
        "not forget where it began, as a drive or a tank (it integrates), so that errors of a "
        f"moment stay in all later outputs; squares gave {squares}, RMS {metrics.rms:.4g}{unit}; "
        "to have them, use loss: {noise_model: white}",
    )
