"""Bands of outputs on the records of a result or on new inputs, and estimated disturbances."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sysid.core.errors import InvalidSettings
from sysid.core.settings import FitSettings, Loss, PredictionKind
from sysid.core.types import FloatArray
from sysid.data.records import Channels, Record, Recording
from sysid.models.model import Model, name_initial_state, replace_substeps
from sysid.models.parse import keep_terms
from sysid.models.starts import replace_starts
from sysid.results.parts import find_sensor_weights
from sysid.results.result import FittedData, FullResult, Result
from sysid.simulation.fit_metrics import ChannelMetrics
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import prepare_simulation
from sysid.uncertainty.disturbances import Disturbance, estimate_disturbances
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.output_bands import (
    NoiseDeviations,
    OutputBands,
    ParameterSpread,
    compute_output_bands,
)


def compute_bands(
    found: FullResult,
    inputs: Channels | Record | Recording | None = None,
    *,
    channels: Mapping[str, str] | None = None,
    times: ArrayLike | None = None,
    experiment: int = 0,
) -> tuple[OutputBands, ...]:
    """Compute the bands of each output; see `Identification.compute_bands`."""
    spread = _read_spread(found)
    data = found.data
    if data is None or spread is None:
        raise InvalidSettings(
            "/bands",
            "the result has no model and records"
            if data is None
            else "the result has no standard errors, so there are no bands",
        )
    if inputs is None:
        records = list_whole_records(data.records, data.validation if data.is_part else ())
        if not 0 <= experiment < len(records):
            detail = f"found {experiment!r}; the result has {len(records)} records, from 0"
            raise InvalidSettings("/experiment", detail)
        return compute_record_bands(found, spread)[experiment]
    model, record, _ = prepare_simulation(data.model, inputs, found, channels, times)
    starts = {name_initial_state(state.name, 0) for state in model.states}
    shared = {parameter.name for parameter in model.parameters} | starts
    estimates = [estimate for estimate in found.parameters if estimate.name in shared]
    noise = pool_noise(found.agreement.estimation, spread.noise_degrees)
    compared = replace(record, outputs=tuple(_fill_missing(one) for one in record.outputs))
    problem, theta = build_fit(model, [compared], estimates, data.ties)
    [bands] = compute_output_bands(problem, theta, spread, noise)
    return bands


def compute_record_bands(
    found: FullResult, spread: ParameterSpread | None = None
) -> tuple[tuple[OutputBands, ...], ...]:
    """Compute the bands on the records of a result; none without errors or records.

    If the last parts of the records were used for validation, they are covered too.
    """
    data, spread = found.data, spread or _read_spread(found)
    if data is None or spread is None:
        return ()
    problem, theta = _rebuild_fit(found, data)
    noise = estimate_noise(found.agreement.estimation, spread.noise_degrees)
    return compute_output_bands(problem, theta, spread, noise)


def compute_disturbances(found: FullResult) -> tuple[tuple[Disturbance, ...], ...]:
    """Compute the disturbances of each record; see `Identification.compute_disturbances`."""
    data, spread = found.data, _read_spread(found)
    if found.plant_noise is None or data is None or spread is None:
        return ()
    return estimate_disturbances(*_rebuild_fit(found, data), spread)


def _rebuild_fit(found: FullResult, data: FittedData) -> tuple[Problem, FloatArray]:
    """Build the problem of a result on its whole records, and its estimate (D,)."""
    model = data.model
    if model.rule is not None and found.selection:
        model = keep_terms(model, [term.term for term in found.selection])
    if found.substeps != model.solver.substeps:
        model = replace_substeps(model, found.substeps)
    return build_fit(
        replace_starts(model, found.initial),
        list_whole_records(data.records, data.validation if data.is_part else ()),
        found.parameters,
        data.ties,
        data.prediction,
        found,
    )


def list_whole_records(records: Sequence[Record], later: Sequence[Record]) -> list[Record]:
    """Join records with their later parts, whose inputs are those of the whole record."""
    if not later:
        return list(records)
    return [
        replace(
            rest,
            outputs=tuple(
                replace(
                    channel,
                    times=np.concatenate([channel.times, after.times]),
                    values=np.concatenate([channel.values, after.values]),
                    repeats=None,
                )
                for channel, after in zip(record.outputs, rest.outputs, strict=True)
            ),
        )
        for record, rest in zip(records, later, strict=True)
    ]


def build_fit(
    model: Model,
    records: Sequence[Record],
    estimates: Iterable[Estimate],
    ties: Mapping[str, str],
    prediction: PredictionKind = "simulation",
    filtered: Result | None = None,
) -> tuple[Problem, FloatArray]:
    """Build the problem of some estimates on records, and its free parameters (D,).

    Parameters
    ----------
    model : Model
        With the selected terms and the integration step of the result.
    ties : mapping of str to str
        Expressions of tied parameters that the model does not tie itself.
    filtered : Result, optional
        The result, if its outputs are to be predictions where noise is inside the plant.
    """
    own_ties = {parameter.name for parameter in model.parameters if parameter.tied is not None}
    values, changes = dict[str, float](), dict[str, dict[str, Any]]()
    for estimate in estimates:
        values[estimate.name] = estimate.value
        if estimate.name in ties:
            changes[estimate.name] = {"tied": ties[estimate.name]}
        elif estimate.status != "tied" or estimate.name not in own_ties:
            changes[estimate.name] = _write_change(estimate)
    weights = {output.name: 1.0 for output in model.outputs}
    settings = FitSettings(changes, prediction, weights=weights)
    if filtered is not None and filtered.plant_noise is not None:
        settings = replace(
            settings,
            loss=Loss(noise_model=filtered.noise_model),
            weights=weights | find_sensor_weights(filtered.plant_noise, values),
            deviations=filtered.noise_deviations,
        )
    problem = Problem.from_settings(model, records, settings)
    return problem, np.array([values[name] for name in problem.free_names])


def estimate_noise(agreement: Iterable[ChannelMetrics], degrees: float) -> NoiseDeviations:
    """Estimate the noise of each output of each record from the residuals of the fit."""
    metrics = list(agreement)
    total = sum(one.samples for one in metrics)
    factor = np.sqrt(total / max(degrees, 1.0))
    return {(one.experiment, one.output): float(factor * one.rms) for one in metrics}


def pool_noise(agreement: Iterable[ChannelMetrics], degrees: float) -> NoiseDeviations:
    """Pool the noise of each output over all records, for one new record."""
    metrics = list(agreement)
    noise, samples = estimate_noise(metrics, degrees), dict[str, int]()
    power = dict[str, float]()
    for one in metrics:
        samples[one.output] = samples.get(one.output, 0) + one.samples
        square = one.samples * noise[one.experiment, one.output] ** 2
        power[one.output] = power.get(one.output, 0.0) + square
    return {(0, name): float(np.sqrt(power[name] / max(samples[name], 1))) for name in power}


def _read_spread(found: FullResult) -> ParameterSpread | None:
    if found.correlation is None or found.covariance is None:
        return None
    has_samples = found.posterior is not None and len(found.posterior.samples) > 0
    return ParameterSpread(
        found.correlation.names,
        found.covariance,
        found.degrees,
        float(found.criteria.samples - found.criteria.parameters),
        found.posterior.samples if found.posterior is not None and has_samples else None,
    )


def _write_change(estimate: Estimate) -> dict[str, Any]:
    """Write the change that frees a parameter in its bounds, or fixes it."""
    if estimate.is_free:
        return {"lower": estimate.lower, "upper": estimate.upper, "scale": "linear"}
    value = estimate.value
    lower, upper = min(estimate.lower, value), max(estimate.upper, value)
    return {"fixed": value, "scale": "linear", "lower": lower, "upper": upper}


def _fill_missing(channel: Any) -> Any:
    """Replace values that are not measured: only the times of a new output count."""
    return replace(channel, values=np.nan_to_num(channel.values))
