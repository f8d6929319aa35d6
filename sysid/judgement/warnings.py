"""Warnings about a result, in whole sentences."""

from collections.abc import Mapping, Sequence

import numpy as np

from sysid.core.settings import GeneticAlgorithm
from sysid.core.units import format_unit
from sysid.identifiability.combinations import IdentifiableCombination
from sysid.judgement.suspects import DYNAMICS, describe_suspects, find_suspects
from sysid.judgement.unrecorded_input import warn_unrecorded_input
from sysid.kernels.signals.past_reads import list_delayed_values
from sysid.models.ties import collect_parameter_names
from sysid.models.unit_checks import (
    list_mixed_unit_warnings,
    list_time_unit_warnings,
    list_unread_unit_warnings,
)
from sysid.residuals.onset_delay import find_unprompted_output
from sysid.residuals.past_outputs import reads_outputs
from sysid.residuals.residual_tests import ResidualTests
from sysid.residuals.sandwich import MIN_REPEATS, count_repeats
from sysid.search.island import get_island_settings
from sysid.simulation.fit_metrics import ChannelMetrics, Metrics
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis
from sysid.uncertainty.estimates import Estimate, NoiseColour, Uncertainty

_RIDGE_CORRELATION = 0.9  # reported for an insignificant time lag: it shares its effect
_STRONG_CORRELATION = 0.95  # reported for any two parameters
_NOTABLE_GAIN = 0.01
_SEPARABLE_STDERRS = 2.0  # standard errors: a smaller time lag is insignificant
_VAGUE_SHARE = 0.5  # of its value: standard error from which a group is practically unidentifiable
_WHITENESS_LEVEL = 1e-3  # probability of such residuals under a true model: below it, warn
_SOLVER_SHARE = 1e-5  # of the output: smaller residuals are the solver's, which has kinks

_STDERR_MEANINGS: Mapping[NoiseColour, str] = {
    "white": "The standard errors are too small.",
    "first-order": "The standard errors are those of the noise model.",
    "coloured": "The standard errors allow for the colour of the residuals, not for missing "
    "dynamics.",
    "clustered": "The standard errors allow for what the samples of a repeat have in common, not "
    "for missing dynamics.",
    "drifting": "The residuals drift over the whole record, so the standard errors are too small.",
}

_NOISE_MODEL_SUGGESTION = " If the noise is coloured, use loss: {noise_model: ar1}"


def collect_warnings(
    problem: Problem,
    algorithm: GeneticAlgorithm,
    analysis: Analysis,
    metrics: Metrics,
    tests: ResidualTests | None = None,
    *,
    is_contradicted: bool = False,
) -> tuple[str, ...]:
    """Collect all warnings, the most important first; `tests` are those of the residuals.

    `is_contradicted`: the data contradict the input that is assumed before the record.
    """
    messages, rms = [], metrics.rms
    limit = algorithm.safe_limit
    if limit is not None and rms > limit:
        messages.append(
            f"the RMS error {rms:.4g} is above the safe limit {limit:g}, so the model is not valid"
        )
    about_units, about_unread_units = problem.share(
        "unit warnings", lambda: _list_unit_warnings(problem)
    )
    messages += about_units
    messages += _warn_active_bounds(analysis)
    messages += _warn_no_prediction(problem)
    messages += _warn_few_repeats(problem, analysis)
    messages += warn_constant_outputs(problem)
    messages += _warn_worse_than_line(metrics.channels)
    messages += _warn_constant_inputs(problem, analysis.estimates)
    messages += _warn_early_response(problem) or warn_unrecorded_input(
        problem, analysis, is_contradicted=is_contradicted
    )
    active_names = {bound.name for bound in analysis.active_bounds or ()}
    messages += [
        text
        for estimate in analysis.estimates
        if (text := _warn_unidentified(estimate, is_reported=estimate.name in active_names))
    ]
    delay_names = find_delay_parameters(problem)
    if analysis.uncertainty is not None:
        messages += [
            text for estimate in analysis.estimates if (text := _warn_insignificant(estimate))
        ]
        messages += [
            text for group in analysis.uncertainty.groups if (text := _warn_vague_group(group))
        ]
        messages += _warn_correlations(analysis.uncertainty, analysis.estimates, delay_names)
    if analysis.is_cut_short:
        messages.append(
            "the time limit left no search for minima near the estimate. Where the loss is rough, "
            "the intervals are too narrow."
        )
    is_of_the_solver = rms <= _SOLVER_SHARE * problem.output_scale
    if analysis.possible_gain > _NOTABLE_GAIN and not is_of_the_solver:
        messages.append(_warn_not_optimal(algorithm, analysis.possible_gain))
    elif tests is not None and not is_of_the_solver:
        loss = problem.loss
        is_plain = loss.kind == "squares" and loss.noise_model != "ar1"
        coloured = _warn_coloured_residuals(tests, delay_names, analysis, may_be_noise=is_plain)
        messages += _name_suspects(problem, analysis, tests, are_white=not coloured) or coloured
    return (*messages, *about_unread_units)


def _list_unit_warnings(problem: Problem) -> tuple[list[str], list[str]]:
    """List the warnings about units: those that come early, and about units not read."""
    model, records = problem.model, problem.records
    return (
        [*list_mixed_unit_warnings(model, records), *list_time_unit_warnings(model)],
        [*list_unread_unit_warnings(model, records)],
    )


def _warn_active_bounds(analysis: Analysis) -> list[str]:
    """Warn about bounds that are too narrow for the data, and say which to widen."""
    if not analysis.active_bounds:
        return []
    first, *others = analysis.active_bounds
    also = f", and {', '.join(map(str, others))}" if others else ""
    cures = " and ".join(bound.advice for bound in analysis.active_bounds)
    return [f"{first}{also}. To widen: {cures}, unless it is a physical limit."]


def _warn_early_response(problem: Problem) -> list[str]:
    """Warn about records whose output leaves its rest before any input has moved."""
    if not list_delayed_values(problem.model, "input"):
        return []
    messages = []
    for number, record in enumerate(problem.records, 1):
        if unprompted := find_unprompted_output(record):
            where = f" in experiment {number}" if len(problem.records) > 1 else ""
            messages.append(
                f"output {unprompted[0]!r} begins to move at t = {unprompted[1]:.4g} s{where}, "
                "before any input. If the record begins with the step itself, the estimated time "
                "lag is wrong: the input is assumed constant before the record. Put some rows "
                "of the input at rest before the record."
            )
    return messages


def _warn_no_prediction(problem: Problem) -> list[str]:
    """Warn if one-step predictions are requested of a model that reads no measured output."""
    if problem.prediction == "simulation" or reads_outputs(problem.model):
        return []
    names = ", ".join(output.name for output in problem.model.outputs)
    return [
        f"no output ({names}) is a state by itself, so one-step predictions equal the free run. "
        "To start each step from the measured output, make it a state in the model's document."
    ]


def _warn_few_repeats(problem: Problem, analysis: Analysis) -> list[str]:
    """Warn about samples of repeats whose spread says too little of the errors."""
    uncertainty, repeats = analysis.uncertainty, count_repeats(problem)
    if not repeats or uncertainty is None or uncertainty.noise_colour == "clustered":
        return []
    needed = max(MIN_REPEATS, len(uncertainty.names) + 2)
    cause = (
        f"too few for errors by repeat. Record at least {needed}"
        if repeats < needed
        else "one of which alone tells of a parameter"
    )
    return [
        f"the samples are pooled from {repeats} repeats, {cause}. The standard errors are those of "
        "one record. They ignore what the samples of a repeat have in common, and may be far off."
    ]


def warn_constant_outputs(problem: Problem) -> list[str]:
    """Warn about outputs whose scored samples are all equal, in every experiment."""
    measured = problem.split_by_output(problem.evaluator.measured)
    weights = problem.split_by_output(problem.evaluator.weight)
    messages = []
    for output in problem.model.outputs:
        values = np.concatenate(
            [y[output.name][w[output.name] > 0] for y, w in zip(measured, weights, strict=True)]
        )
        if np.ptp(values) == 0.0:
            unit = format_unit(output.unit)
            messages.append(
                f"output {output.name!r} is constant ({values[0]:.4g}{unit}) at all "
                f"{values.size} samples: it contains no dynamics, and the fit % is undefined. "
                "Choose another channel, or a record in which it moves"
            )
    return messages


def _warn_worse_than_line(channels: Sequence[ChannelMetrics]) -> list[str]:
    """Warn if a straight line through an output fits better than the model."""
    has_several = any(channel.experiment for channel in channels)
    return [
        f"the model fits {channel.output}"
        f"{f' of experiment {channel.experiment + 1}' if has_several else ''} worse than a "
        f"straight line (RMS {channel.rms:.4g} against {channel.line_rms:.4g}"
        f"{format_unit(channel.unit)})"
        for channel in channels
        if channel.is_worse_than_line
    ]


def _warn_unidentified(estimate: Estimate, *, is_reported: bool) -> str:
    """Warn about an estimate that the data do not determine.

    `is_reported`: another warning says at which bound it lies, and which bounds to widen.
    """
    low = estimate.value < 0.5 * (estimate.lower + estimate.upper)
    side, bound = ("lower", estimate.lower) if low else ("upper", estimate.upper)
    unit = format_unit(estimate.unit)
    position = f"lies at its {side} bound {bound:g}{unit}"
    match estimate.status:
        case "at bound":
            return "" if is_reported else f"{estimate.name} {position}"
        case "group" | "unidentifiable":
            also = f"; it {position}" if estimate.value == bound else ""
            return f"{estimate.name} is not identified: {estimate.reason}{also}"
    return ""


def _warn_insignificant(estimate: Estimate) -> str:
    """Warn about a quantity that cannot be negative and is not distinguishable from 0.

    Where both signs are allowed (an offset, an initial state), 0 is a value like any other.
    """
    if estimate.status != "identified" or not estimate.stderr or estimate.lower < 0:
        return ""
    if estimate.stderr < estimate.value:
        return ""
    unit = format_unit(estimate.unit)
    return (
        f"the standard error of {estimate.name}, {estimate.stderr:.3g}{unit}, is as large as its "
        f"value, {estimate.value:.3g}{unit}"
    )


def _warn_vague_group(group: IdentifiableCombination) -> str:
    if not group.stderr or group.stderr < _VAGUE_SHARE * abs(group.value):
        return ""
    return (
        f"{group.text} is practically unidentifiable: {group.value:.3g} with a standard "
        f"error of {group.stderr:.3g}"
    )


def find_delay_parameters(problem: Problem) -> set[str]:
    """Find the names of the parameters that time lags depend on."""
    names = problem.share("delay parameters", lambda: _collect_delay_parameters(problem))
    return names & set(problem.free_names)


def _collect_delay_parameters(problem: Problem) -> set[str]:
    past_values = [
        *list_delayed_values(problem.model, "input"),
        *list_delayed_values(problem.model, "state"),
    ]
    names: set[str] = set()
    for past_value in past_values:
        if past_value.delay is not None:
            names |= collect_parameter_names(past_value.delay)
    return names


def _warn_correlations(
    uncertainty: Uncertainty, estimates: tuple[Estimate, ...], delay_names: set[str]
) -> list[str]:
    """Warn about strongly correlated estimates.

    A time lag that is not distinguishable from 0 is not separable from a correlated parameter.
    Coloured residuals turn the ellipsoid of the estimates, but the correlation of the
    sensitivities stays. Parameters without a standard error are described by their groups.
    """
    without_stderr = {e.name for e in estimates if e.stderr is None}
    insignificant = {
        e.name for e in estimates if e.name in delay_names and _is_insignificant_delay(e)
    }
    messages = []
    for i, first in enumerate(uncertainty.names):
        for j in range(i + 1, len(uncertainty.names)):
            second, r = uncertainty.names[j], float(uncertainty.correlation[i, j])
            if {first, second} & without_stderr:
                continue
            alike = float(uncertainty.sensitivity_correlation[i, j])
            if {first, second} & insignificant and max(abs(r), abs(alike)) > _RIDGE_CORRELATION:
                plain = (
                    ""
                    if abs(r) > _RIDGE_CORRELATION
                    else f", {alike:.3f} if the residuals were white"
                )
                messages.append(
                    f"{first} and {second} not separable (correlation {r:.3f}{plain}): the data "
                    "fix only a combination of them. The time lag is less than two of its "
                    "standard errors."
                )
            elif abs(r) > _STRONG_CORRELATION:
                messages.append(
                    f"{first} and {second} have the correlation {r:.3f}: "
                    "the data fix a combination of them better than each alone"
                )
    return messages


def _is_insignificant_delay(estimate: Estimate) -> bool:
    return (
        estimate.stderr is not None and abs(estimate.value) < _SEPARABLE_STDERRS * estimate.stderr
    )


def _warn_coloured_residuals(
    tests: ResidualTests,
    delay_names: set[str],
    analysis: Analysis,
    *,
    may_be_noise: bool,
) -> list[str]:
    """Warn about residuals that are clearly not white: dynamics are missing, often an order.

    A time lag compensates for a missing order. The result itself reports whether the tests are
    passed. A true model fails them often enough, so a warning needs stronger evidence. Residuals
    that depend on an input contain dynamics, and no noise model describes these. Residuals that
    do not may be slow noise (Ljung, System Identification, 2nd ed., ch. 16.6). On validation data
    alone, errors of the estimates look the same as missing dynamics. The standard errors are
    correct then. A time lag at its bound explains the residuals as well as a missing order does.
    """
    uncertainty = analysis.uncertainty
    if all(
        test.test != "whiteness" or test.p is None or test.p > _WHITENESS_LEVEL
        for test in tests.tests
    ):
        return []
    colour = "white" if uncertainty is None else uncertainty.noise_colour
    depends = any(test.test == "independence" and test.outcome == "failed" for test in tests.tests)
    advises = may_be_noise and colour in ("coloured", "drifting") and not depends
    if delay_names and uncertainty and (tests.data, colour) == ("validation", "white"):
        return [
            "the residuals are consistent with white noise on the estimation data, but not on the "
            "validation data. Either dynamics are missing from the model, or parameters are known "
            "too roughly. Estimate from data that cover both."
        ]
    bounded = delay_names & {one.name for one in analysis.estimates if one.status == "at bound"}
    if bounded:
        names = ", ".join(sorted(bounded))
        return [
            f"the residuals are not white (on the {tests.data} data). The bound of {names} may be "
            f"the cause. {_STDERR_MEANINGS[colour]}"
        ]
    if delay_names:
        suggestion = _NOISE_MODEL_SUGGESTION if advises else ""
        return [
            f"the residuals are not white (on the {tests.data} data): dynamics are missing from "
            f"the model. The estimate of {', '.join(sorted(delay_names))} depends on the order of "
            f"the model. {_STDERR_MEANINGS[colour]}{suggestion}"
        ]
    if not advises:
        return []
    return [
        f"the residuals are not white (on the {tests.data} data), and no input explains them. "
        f"Least squares gives slow noise too much weight.{_NOISE_MODEL_SUGGESTION}"
    ]


def _name_suspects(
    problem: Problem, analysis: Analysis, tests: ResidualTests, *, are_white: bool
) -> list[str]:
    """Name what left the residuals, unless it is a lack of dynamics."""
    suspects = find_suspects(problem, analysis, are_white=are_white)
    if not suspects or suspects[0].name == DYNAMICS or analysis.uncertainty is None:
        return []
    if are_white:
        return [f"the residuals point to {describe_suspects(suspects)}"]
    meaning = _STDERR_MEANINGS[analysis.uncertainty.noise_colour]
    return [
        f"the residuals are not white (on the {tests.data} data). They point to "
        f"{describe_suspects(suspects)}. {meaning}"
    ]


def warn_time_limit(is_cut_short: bool) -> tuple[str, ...]:
    """Warn if the time limit ended the refinement."""
    if not is_cut_short:
        return ()
    return (
        "the time limit ended least squares before all islands' champions were refined. The "
        "estimate is the best so far and need not be the optimum. Allow more seconds, or use a "
        "shorter record.",
    )


def warn_noise_model(
    problem: Problem, correlation_times: Mapping[str, float], is_complete: bool
) -> tuple[str, ...]:
    """Describe the effect of the noise model, or why it had none."""
    if problem.loss.noise_model != "ar1":
        return ()
    times = [f"{name} {time:.3g} s" for name, time in correlation_times.items() if time > 0]
    notes = []
    if times:
        notes.append(
            "estimates and standard errors assume first-order noise with a correlation time of "
            f"{', '.join(times)}. Least squares alone would give a smaller RMS."
        )
    elif is_complete:
        notes.append(
            "the residuals are consistent with white noise, so the noise model changes nothing"
        )
    if not is_complete:
        notes.append(
            "the noise model was not estimated completely. It needs the method 'improved' with "
            "refinement, and more simulations than budget and time allowed."
        )
    return tuple(notes)


def _warn_constant_inputs(problem: Problem, estimates: tuple[Estimate, ...]) -> list[str]:
    """Warn about inputs that are constant in every record, and parameters they leave open."""
    unidentified = ", ".join(
        e.name for e in estimates if e.status in ("group", "unidentifiable") and e.stderr is None
    )
    messages = []
    for quantity in problem.model.inputs:
        values = [
            channel.values
            for record in problem.records
            for channel in record.inputs
            if channel.name == quantity.name
        ]
        if unidentified and all(float(np.ptp(signal)) == 0.0 for signal in values):
            messages.append(
                f"input {quantity.name!r} is constant, so it excites nothing. Choose another "
                "channel, or a record in which it moves. These data leave unidentified: "
                f"{unidentified}"
            )
    return messages


def _warn_not_optimal(algorithm: GeneticAlgorithm, gain: float) -> str:
    methods = {get_island_settings(algorithm, i).method for i in range(algorithm.n_islands)}
    text = (
        "the estimate is not a local optimum: one least-squares step would remove "
        f"{100 * gain:.0f} % of the squared error, so the standard errors are rough"
    )
    return text if "improved" in methods else f"{text} ({', '.join(sorted(methods))}: as found)"
