"""Load the data of figures: signals from the object store, results from stored rows."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from math import inf, isnan
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import Conflict
from service.datasets.recordings import load_recording
from service.formats.mcap import FitRole, FittedOutput
from service.jobs.stored_run import StoredRun
from service.repositories.runs import RunRepository
from service.runs.bands import load_bands
from service.runs.fitted import load_fitted_signals
from service.runs.residuals import ResidualAnalysis, analyse_residuals
from service.storage.errors import ObjectMissing, RowNotFound
from service.storage.objects import ObjectStore
from service.storage.tables import Dataset
from sysid.core.errors import SysidError
from sysid.core.text import find_shown_error
from sysid.figures.data import (
    CornerParameter,
    ExperimentTraces,
    Floats,
    FreeParameter,
    IslandImprovement,
    OutputTraces,
    RunFigureData,
    SignalTrace,
)
from sysid.models.parameters import Parameter, ParameterScale
from sysid.results.figures import (
    RecordTraces,
    add_bands,
    arrange_experiments,
    label_fitness,
    to_signal_trace,
)
from sysid.uncertainty.estimates import Estimate


def list_free_parameters(session: Session, stored: StoredRun) -> list[FreeParameter]:
    """List the free parameters in the order of the history's columns.

    They come from the result once the run has ended; before, from the model and the request.
    """
    parameters = stored.parameters(session)
    if stored.estimates:
        scales = {parameter.name: parameter.scale for parameter in parameters}
        return [
            _to_estimated_parameter(estimate, scales)
            for estimate in stored.estimates
            if estimate.is_free
        ]
    if stored.model.rule is not None:
        return []  # only the result says which candidates are selected
    return [_to_free_parameter(parameter) for parameter in parameters if parameter.is_free]


def read_run_figure_data(session: Session, stored: StoredRun) -> RunFigureData:
    """Read the data of a run's search and result."""
    job, run, body = stored.job, stored.run, stored.body
    runs = RunRepository(session)
    history = _group_by_island(runs.read_history(run.id))
    return RunFigureData(
        id=run.id,
        unit=stored.rms_unit(session),
        fitness_label=label_fitness(body["loss"]["kind"]),
        generations=run.generations or (job.generation if job.n_runs == 1 else 0),
        evaluations=run.evaluations,
        history=history,
        parameters=_match_history_width(list_free_parameters(session, stored), history),
        epoch=int((body["algorithm"].get("migration") or {}).get("every", 0)),
        migrations=sorted({migration.epoch for migration in runs.read_migrations(run.id)}),
        islands=[]
        if stored.result is None
        else [
            (inf if isnan(i.champion_rms) else i.champion_rms, i.refined_rms)
            for i in stored.result.islands
        ],
        correlation=None
        if stored.result is None or stored.result.correlation is None
        else {"names": stored.result.correlation.names, "matrix": stored.result.correlation.matrix},
    )


def read_corner_parameters(stored: StoredRun) -> tuple[list[CornerParameter], Floats]:
    """Read the samples of a run's posterior, and the correlation of its estimates (D, D).

    There are none if no posterior was requested, or none could be sampled.
    """
    result = stored.result
    if result is None or result.posterior is None:
        return [], np.array([])
    estimates = {estimate.name: estimate for estimate in result.parameters}
    parameters = [
        CornerParameter(
            **{
                name: getattr(estimates[parameter.name], name)
                for name in ("name", "unit", "lower", "upper", "value", "stderr", "interval95")
            },
            posterior95=parameter.interval95,
            samples=result.posterior.samples[:, column],
        )
        for column, parameter in enumerate(result.posterior.parameters)
    ]
    correlation = result.correlation
    return parameters, np.array([]) if correlation is None else correlation.matrix


def _group_by_island(rows: Sequence[Any]) -> list[list[IslandImprovement]]:
    by_island: list[list[IslandImprovement]] = []
    for island, points in groupby(rows, key=lambda row: row.island):
        while len(by_island) < island:  # an island without any improvement yet
            by_island.append([])
        by_island.append(
            [
                IslandImprovement(p.generation, p.evaluations, p.rms, p.phase, tuple(p.parameters))
                for p in points
            ]
        )
    return by_island


def _match_history_width(
    parameters: list[FreeParameter], history: Sequence[Sequence[IslandImprovement]]
) -> list[FreeParameter]:
    """Match the number of parameters to the history's columns; the model may have changed."""
    points = [point for island in history for point in island]
    if not points:
        return parameters
    width = len(points[0].parameters)
    parameters = [
        _show_history(parameter, points, column) if parameter.follows_data else parameter
        for column, parameter in enumerate(parameters[:width])
    ]
    unknown = range(min(len(parameters), width), width)
    return parameters[:width] + [_infer_parameter(points, column) for column in unknown]


def _show_history(
    parameter: FreeParameter, points: Sequence[IslandImprovement], column: int
) -> FreeParameter:
    """Replace unknown bounds by the range of the history."""
    shown = _infer_parameter(points, column)
    return replace(parameter, lower=shown.lower, upper=shown.upper)


def _infer_parameter(points: Sequence[IslandImprovement], column: int) -> FreeParameter:
    values = [point.parameters[column] for point in points]
    lower, upper = min(values), max(values)
    return FreeParameter(
        f"parameter {column + 1}", "1", lower, upper if upper > lower else lower + 1.0
    )


def _to_estimated_parameter(
    estimate: Estimate, scales: Mapping[str, ParameterScale]
) -> FreeParameter:
    return FreeParameter(
        estimate.name,
        estimate.unit,
        estimate.lower,
        estimate.upper,
        scales.get(estimate.name, "linear"),
        value=estimate.value,
        stderr=find_shown_error(estimate.stderr, estimate.status),
    )


def _to_free_parameter(parameter: Parameter) -> FreeParameter:
    return FreeParameter(
        parameter.name,
        parameter.unit,
        parameter.lower,
        parameter.upper,
        parameter.scale,
        follows_data=parameter.bounds is not None,
    )


def read_dataset_traces(store: ObjectStore, dataset: Dataset) -> list[SignalTrace]:
    """Read the channels of a dataset."""
    return [to_signal_trace(channel) for channel in load_recording(store, dataset.sha256).channels]


def read_residual_analysis(
    session: Session, store: ObjectStore, stored: StoredRun
) -> ResidualAnalysis | None:
    """Analyse a run's residuals; None until it has signals, or without data."""
    try:
        return analyse_residuals(session, store, stored)
    except Conflict:
        return None


def read_run_experiments(
    session: Session, store: ObjectStore, stored: StoredRun
) -> list[ExperimentTraces]:
    """Read the records that a run was fitted to; empty until it has signals, or without data.

    Outputs have their bands where these can be computed.
    """
    experiments = read_plain_experiments(session, store, stored)
    if not experiments or not stored.estimates:
        return experiments
    try:
        return add_bands(experiments, load_bands(session, store, stored))
    except Conflict:  # no standard errors, or a dataset was deleted
        return experiments


def read_plain_experiments(
    session: Session, store: ObjectStore, stored: StoredRun
) -> list[ExperimentTraces]:
    """Read the same records without bands, which take simulations."""
    try:
        fits = load_fitted_signals(session, store, stored)
    except Conflict:  # a dataset was deleted: the other figures are shown
        return []
    if fits is None:
        return []
    fitted = _by_experiment(fits)
    estimation, validation = fitted["estimation"], fitted["validation"]
    validation_settings = stored.body["validation"] or {}
    is_part = validation_settings.get("fraction") is not None
    others = [] if is_part else validation_settings.get("datasets") or []
    inputs = list(_read_inputs(session, store, stored, stored.body["datasets"]))
    later = inputs if is_part else list(_read_inputs(session, store, stored, others))
    if is_part:
        validation = {number: validation.get(number, ()) for number in estimation}
    return arrange_experiments(
        _pair_with_inputs(estimation, inputs),
        _pair_with_inputs(validation, later),
        is_part=is_part,
    )


def _pair_with_inputs(
    outputs: Mapping[int, Sequence[FittedOutput]], inputs: Sequence[tuple[SignalTrace, ...]]
) -> list[RecordTraces]:
    return [
        (_to_output_traces(parts), _get_inputs(inputs, number)) for number, parts in outputs.items()
    ]


def _by_experiment(
    fits: Iterable[FittedOutput],
) -> dict[FitRole, dict[int, Sequence[FittedOutput]]]:
    """Group the outputs by role and by number of the experiment."""
    by_role: dict[FitRole, dict[int, list[FittedOutput]]] = {"estimation": {}, "validation": {}}
    for fit in fits:
        by_role[fit.role].setdefault(fit.number, []).append(fit)
    return {role: dict(sorted(numbered.items())) for role, numbered in by_role.items()}


def _to_output_traces(parts: Iterable[FittedOutput]) -> tuple[OutputTraces, ...]:
    return tuple(
        OutputTraces(SignalTrace(part.name, part.unit, part.times, part.measured), part.simulated)
        for part in parts
    )


def _get_inputs(inputs: Sequence[tuple[SignalTrace, ...]], number: int) -> tuple[SignalTrace, ...]:
    return inputs[number - 1] if number <= len(inputs) else ()


def _read_inputs(
    session: Session, store: ObjectStore, stored: StoredRun, datasets: Sequence[str]
) -> Iterator[tuple[SignalTrace, ...]]:
    """Read the inputs of every record; a deleted dataset omits only its own inputs."""
    for name in datasets:
        try:
            for record in stored.read_datasets(session, store, [name]):
                yield tuple(to_signal_trace(channel) for channel in record.inputs)
        except (RowNotFound, ObjectMissing, SysidError):
            yield ()
