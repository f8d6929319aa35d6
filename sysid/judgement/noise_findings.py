"""Findings about noise that are no explanation of residuals: its model, feedback, tests."""

from collections.abc import Iterator, Mapping

from sysid.core.findings import Finding, note
from sysid.core.text import join_names, plain_unit
from sysid.core.types import FloatArray
from sysid.judgement.judge import Explained
from sysid.judgement.levels import UNLIKELY
from sysid.residuals.feedback import describe_feedback
from sysid.residuals.residual_tests import ResidualTests, list_residual_series
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis


def find_feedback(problem: Problem, simulated: FloatArray, analysis: Analysis) -> Iterator[Finding]:
    """Find feedback from outputs to inputs, unless there is no controller.

    With white residuals it does no harm.
    """
    uncertainty = analysis.uncertainty
    is_white = uncertainty is not None and uncertainty.noise_colour == "white"
    if is_white or problem.settings.commands == ():
        return
    for text in describe_feedback(list_residual_series(problem, simulated)):
        yield Finding(
            "feedback",
            "input",
            "caution",
            "the input follows the output: a closed loop without excitation",
            text,
            parameters=tuple(one.name for one in analysis.estimates if one.is_free),
        )


def find_loop(problem: Problem, asked: Problem) -> Iterator[Finding]:
    """Find what was assumed because a controller computes inputs, which nobody `asked` for."""
    commands = problem.settings.commands
    if not commands or asked.settings.commands is not None:
        return
    for name in commands:
        yield note(
            "closed loop",
            "record",
            f"{name} follows the residuals as the command of a controller does, so it is read "
            f"held. If there is no controller, use hold: {{{name}: first}}.",
        )


def find_noise_model(
    problem: Problem,
    correlation_times: Mapping[str, float],
    squares: FloatArray,
    *,
    is_complete: bool,
) -> Iterator[Finding]:
    """Find what the noise model does, or why it does nothing.

    `squares` (D,) are the estimates of least squares.
    """
    if problem.loss.noise_model != "ar1":
        return
    times = [f"{name} {time:.3g} s" for name, time in correlation_times.items() if time > 0]
    if times:
        plain = ", ".join(
            f"{parameter.name} = {value:.4g}{plain_unit(parameter.unit)}"
            for parameter, value in zip(problem.free_parameters, squares.tolist(), strict=True)
        )
        yield note(
            "coloured noise",
            "noise",
            "estimates and standard errors assume first-order noise with a correlation time of "
            f"{', '.join(times)}. Plain least squares (loss: {{noise_model: white}}) gives "
            f"{plain}.",
        )
    elif is_complete:
        yield note(
            "white noise",
            "noise",
            "the residuals are consistent with white noise, so the noise model changes nothing",
        )
    if not is_complete:
        yield note(
            "noise model",
            "noise",
            "the noise model was not estimated completely. It needs the method 'improved' with "
            "refinement, and more simulations than budget and time allowed.",
        )


def find_plant_noise(
    problem: Problem, free_run: Mapping[str, float], gain: float
) -> Iterator[Finding]:
    """Find why a filter was chosen, with the estimates of the free run by squares.

    `gain` is by how much the filter lowers Schwarz's criterion.
    """
    units = {parameter.name: parameter.unit for parameter in problem.free_parameters}
    plain = ", ".join(
        f"{name} = {value:.4g}{plain_unit(units[name])}"
        for name, value in free_run.items()
        if name in units
    )
    source = "noise inside the plant"
    if problem.loss.noise_model == "drift":
        source = f"drift of {join_names([one.name for one in problem.model.outputs])}"
    yield note(
        "noise in the plant",
        "noise",
        f"{source} explains the residuals better than coloured noise (BIC {gain:.3g} lower), so a "
        f"filter follows it. Plain least squares (loss: {{noise_model: white}}) gives {plain}.",
    )


def find_unexplained(
    tests: ResidualTests, explained: Explained, analysis: Analysis
) -> Iterator[Finding]:
    """Find tests of residuals that fail, and that no explanation was looked for."""
    failed = [
        test for test in tests.tests if test.outcome == "failed" and (test.p or 0.0) <= UNLIKELY
    ]
    inputs = dict.fromkeys(test.input for test in failed if test.input)
    if inputs and (tests.data == "validation" or not explained.is_done):
        names = join_names(list(inputs))
        yield Finding(
            "dependence on an input",
            "structure",
            "caution",
            f"the residuals depend on {names}",
            f"the residuals on the {tests.data} data depend on {names}: "
            + (
                "the model does not hold there, or its estimates are not exact enough for them."
                if tests.data == "validation"
                else "a part of the response is missing from the model."
            ),
        )
    elif failed and not explained.is_done:
        yield Finding(
            "residuals",
            "noise",
            "caution",
            "the residuals are not noise",
            f"the residuals on the {tests.data} data are not white, and why was not looked for.",
        )
    colour = "" if analysis.uncertainty is None else analysis.uncertainty.noise_colour
    if colour == "drifting":
        yield Finding(
            "coloured noise",
            "noise",
            "caution",
            "the residuals drift over the whole record",
            "the residuals drift over the whole record, so the standard errors are too small.",
        )
    elif colour == "coloured":
        yield note(
            "coloured noise",
            "noise",
            "the noise is coloured, and the standard errors allow for it",
        )
