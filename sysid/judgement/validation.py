"""Validation of estimates on data that were not used for them."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sysid.core.errors import InvalidRecord
from sysid.core.findings import Finding, note
from sysid.core.types import FloatArray
from sysid.core.units import format_unit
from sysid.data.records import keep_outputs
from sysid.residuals.residual_tests import ResidualTests, run_residual_tests
from sysid.search.refine import refine_candidates
from sysid.simulation.fit_metrics import Metrics
from sysid.simulation.problem import Problem, compute_metrics
from sysid.uncertainty.estimates import Estimate

_STILL_SHARE = 0.3  # of the estimation data's variation: validation data with less hardly move
_STILL_NOISE = 2.0  # of the estimation RMS: and with less they show mostly noise
_NOTABLE_LOSS = 20.0  # percentage points of fit, from estimation to validation
_START_SHARE = 0.3  # of a validation record: its first part gives its initial states


class Validation(NamedTuple):
    """Agreement with validation data; `spread` is the RMS of their mean.

    `is_still`: they hardly move, so that their fit % says nothing and is undefined.
    """

    metrics: Metrics
    simulated: tuple[tuple[FloatArray, ...], ...]
    tests: ResidualTests
    spread: float
    is_still: bool

    @property
    def is_refuted(self) -> bool:
        """Whether their own mean fits the data better; False if the fit % is undefined."""
        return self.metrics.fit_percent < 0.0


def validate_estimates(
    validation: Problem,
    estimation: Problem,
    estimates: tuple[Estimate, ...],
    correlation_times: Mapping[str, float],
    metrics: Metrics,
) -> Validation:
    """Simulate data that were not used for the estimate, and measure the agreement.

    Parameters and output weights are those of the estimate, so both RMS use the same measure. An
    initial state belongs to its record. If the last part of the same records is validated, it is
    the estimated one. On other records only the initial state is estimated, on their first part.
    `metrics` are those of the estimation data.
    """
    fixed_problem, simulated, scored = simulate_validation(validation, estimation, estimates)
    agreement, spread = compute_metrics(fixed_problem, simulated), fixed_problem.output_scale
    is_still = spread < _STILL_SHARE * estimation.output_scale and (
        agreement.fit_percent < 0.0 or spread < _STILL_NOISE * metrics.rms
    )
    return Validation(
        _leave_out_fit(agreement) if is_still else agreement,
        scored,
        run_residual_tests(fixed_problem, simulated, "validation", correlation_times),
        spread,
        is_still,
    )


class ValidationRun(NamedTuple):
    """Simulation of validation data: its problem, values (n,), and their scored part by output."""

    problem: Problem
    simulated: FloatArray
    scored: tuple[tuple[FloatArray, ...], ...]


def simulate_validation(
    validation: Problem, estimation: Problem, estimates: Sequence[Estimate]
) -> ValidationRun:
    """Simulate validation data with all estimates fixed, as `validate_estimates` says."""
    changes = validation.settings.parameters
    is_part = validation.settings.scored_from is not None
    # Other records may start otherwise, if the data were to tell how the fitted ones start.
    initial = (estimation if is_part else validation).settings.initial
    loss, commands = estimation.loss, estimation.settings.commands
    if (validation.loss, validation.settings.commands) != (loss, commands):  # they were chosen
        validation = validation.rebuild(loss=loss, commands=commands)
    declared = validation.model.parameters
    shared = {p.name for p in (validation.all_parameters if is_part else declared)}
    fixed = {e.name: _to_fixed_parameter(e) for e in estimates if e.name in shared}
    other_changes = {name: fields for name, fields in changes.items() if name not in shared}
    fixed_problem = validation.rebuild(
        model=estimation.given_model,
        initial=initial,
        parameters={**other_changes, **fixed},
        weights=estimation.output_weights,
    )
    theta = _estimate_starts(fixed_problem) if fixed_problem.free_parameters else np.zeros(0)
    simulated = fixed_problem.predict(theta[None])[0]
    scored = _select_scored_part(fixed_problem, split_outputs(fixed_problem, simulated))
    return ValidationRun(fixed_problem, simulated, scored)


def _estimate_starts(problem: Problem) -> FloatArray:
    """Estimate the initial states of validation data on the first part of each record.

    So the rest is predicted. A record of which nothing is scored there is used as a whole.
    """
    first = keep_outputs(
        problem.records,
        lambda one: np.arange(one.values.size) < _START_SHARE * one.values.size,
    )
    with suppress(InvalidRecord):  # nothing in it is scored
        problem = problem.rebuild(records=first, weights=problem.output_weights)
    middle = 0.5 * (problem.evaluator.lower + problem.evaluator.upper)
    start = refine_candidates(problem, [middle])[0]
    return middle if start is None else start.theta


def _leave_out_fit(metrics: Metrics) -> Metrics:
    channels = tuple(replace(channel, fit_percent=float("nan")) for channel in metrics.channels)
    return replace(metrics, fit_percent=float("nan"), channels=channels)


def find_contradictions(
    problem: Problem,
    metrics: Metrics,
    validated: Validation | None,
    estimates: Sequence[Estimate],
) -> Iterator[Finding]:
    """Find validation data that contradict the model, or that say nothing of it."""
    if validated is None:
        return
    unit, other = format_unit(metrics.unit), validated.metrics
    if validated.is_still:
        yield note(
            "still validation data",
            "validation",
            f"the validation data hardly move: their standard deviation is {validated.spread:.3g}"
            f"{unit}, that of the estimation data {problem.output_scale:.3g}{unit}. So their fit % "
            f"says nothing. Compare the RMS: {other.rms:.3g}{unit} in validation, "
            f"{metrics.rms:.3g}{unit} in estimation.",
        )
    elif validated.is_refuted:
        yield Finding(
            "validation",
            "validation",
            "serious",
            "the validation data contradict the model",
            "the model predicts the validation data worse than their mean: RMS "
            f"{other.rms:.3g}{unit} against {validated.spread:.3g}{unit}, and {metrics.rms:.3g}"
            f"{unit} in estimation. Dynamics or a disturbance are missing from the model, or the "
            "estimation data do not determine what validation needs.",
            parameters=tuple(one.name for one in estimates if one.is_free),
            status="refuted",
            reason="the model predicts the validation data worse than their mean",
        )
    elif metrics.fit_percent - other.fit_percent > _NOTABLE_LOSS:
        yield Finding(
            "validation",
            "validation",
            "caution",
            "it fits the validation data worse",
            f"the fit is {metrics.fit_percent:.1f} % in estimation, and {other.fit_percent:.1f} % "
            "in validation. The model does not hold for both.",
        )


def _to_fixed_parameter(estimate: Estimate) -> dict[str, float | str]:
    """Fix a parameter at its estimate; that of a tie may lie outside the bounds."""
    value = estimate.value
    bounds = {"lower": min(estimate.lower, value), "upper": max(estimate.upper, value)}
    return {"fixed": value, "scale": "linear", **bounds}


def _select_scored_part(
    problem: Problem, simulated: tuple[tuple[FloatArray, ...], ...]
) -> tuple[tuple[FloatArray, ...], ...]:
    """Select the simulated samples from the time on at which the records are scored."""
    scored_from = problem.settings.scored_from
    if scored_from is None:
        return simulated
    names = [output.name for output in problem.model.outputs]
    scored = []
    for record, since, outputs in zip(problem.records, scored_from, simulated, strict=True):
        times = {channel.name: channel.times for channel in record.outputs}
        late = [times[name] >= since for name in names]
        scored.append(tuple(part[mask] for part, mask in zip(outputs, late, strict=True)))
    return tuple(scored)


def split_outputs(problem: Problem, values: FloatArray) -> tuple[tuple[FloatArray, ...], ...]:
    """Split predicted values (n,) by record and output."""
    names = [output.name for output in problem.model.outputs]
    return tuple(tuple(part[name] for name in names) for part in problem.split_by_output(values))
