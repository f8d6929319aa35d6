"""Use case: simulate the identified model of a run on another recording, and measure the fit.

All estimates are fixed. Initial states belong to a recording. Those that the model does not fix are
therefore estimated on it, as on the validation data of a job.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest
from service.datasets.datasets import to_series
from service.datasets.signal_channels import SignalChannels, map_channels
from service.datasets.stored_recordings import read_records
from service.jobs.stored_run import StoredRun, load_estimated_run
from service.queue.daily_limit import compute_on_request
from service.repositories.dataset_rows import DatasetRepository
from service.runs.run_schemas import AgreementOut, ExperimentOut, FreeRunIn, FreeRunOut
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from service.storage.storage_errors import StorageError
from service.storage.tables import Dataset
from sysid.core.errors import InvalidRecord, RecordTooShort, suggest_name
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.model import build_initial_parameters, name_initial_state
from sysid.models.unit_checks import SignalUnits
from sysid.simulation.fit_metrics import Metrics
from sysid.uncertainty.estimates import Estimate

if TYPE_CHECKING:
    from sysid.simulation.problem import Problem


MAX_SAMPLES = 1_000_000
MAX_RECORDS = 2000
MAX_STEPS = 1_000_000_000
"""Integration or recursion steps in a search for initial states: about ten seconds."""
MIN_SIMULATIONS = 100
MAX_WORK = 30_000_000
"""Measured values × initial states searched together. Their derivatives are held in memory."""


@dataclass(frozen=True, slots=True, eq=False)
class FreeRun:
    """Records, simulated outputs of each, and their agreement."""

    run: str
    dataset: str
    records: tuple[Record, ...]
    simulated: tuple[tuple[FloatArray, ...], ...]
    metrics: Metrics
    starts: dict[str, float]


def validate_run(
    database: Database, store: ObjectStore, run_id: str, body: FreeRunIn, max_points: int
) -> FreeRunOut:
    """Simulate a run's model on a dataset and measure the fit.

    Raises
    ------
    NotFound
        If there is no such run or dataset.
    Conflict
        If the run has no estimates.
    InvalidRequest
        If the recording does not have what the model needs, or the simulation diverges.
    """
    free_run = simulate_free_run(database, store, run_id, body)
    return FreeRunOut.from_source(
        free_run.metrics,
        id=free_run.run,
        dataset=free_run.dataset,
        starts=free_run.starts,
        agreement=[
            AgreementOut.from_source(channel, experiment=channel.experiment + 1)
            for channel in free_run.metrics.channels
        ],
        experiments=list(_to_experiments_out(free_run, max_points)),
    )


def simulate_free_run(
    database: Database, store: ObjectStore, run_id: str, body: FreeRunIn
) -> FreeRun:
    """Simulate as `validate_run` does, but return arrays. Raises the same errors."""
    with compute_on_request(database):
        with database.read_session() as session:
            problem, row = _read_problem(session, store, run_id, body)
        return _evaluate_free_run(problem, run_id, row)


def _read_problem(
    session: Session, store: ObjectStore, run_id: str, body: FreeRunIn
) -> "tuple[Problem, Dataset]":
    stored = load_estimated_run(session, run_id, "simulate with")
    row = DatasetRepository(session, stored.job.project_id).get(body.dataset)
    named = {**stored.body["channels"], **body.channels}
    channels = map_channels(stored.model, named, stored.body["hold"])
    faults = [
        *_find_channel_faults(row, named, channels),
        *_find_unit_faults(session, stored, row, channels),
    ]
    if faults:
        raise InvalidRequest(faults)
    records = _read_records(store, row, channels)
    return _build_problem(stored, records, body.skip), row


def _find_channel_faults(
    row: Dataset, named: Mapping[str, str], channels: SignalChannels
) -> Iterator[FieldError]:
    signals = list(channels.by_signal)
    recorded = [str(channel["name"]) for channel in row.channels]
    for name in named:
        if name not in signals:
            detail = f"the model has no signal {name!r}{suggest_name(name, signals)}"
            yield FieldError(f"/channels/{name}", detail)
    for name, recorded_name in channels.by_signal.items():
        if recorded_name not in recorded:
            yield FieldError(
                f"/channels/{name}",
                f"{row.name!r} has no channel {recorded_name!r}"
                f"{suggest_name(recorded_name, recorded)}. It has {', '.join(recorded)}",
            )
    if row.n_samples > MAX_SAMPLES:
        yield FieldError(
            "/dataset",
            f"{row.name!r} has {row.n_samples} samples; a request may have at most "
            f"{MAX_SAMPLES}. Derive a shorter dataset with 'trim' or 'resample'",
        )


def _find_unit_faults(
    session: Session, stored: StoredRun, row: Dataset, channels: SignalChannels
) -> Iterator[FieldError]:
    """Report channels whose unit differs from the model's, or from the fitted dataset's."""
    units = SignalUnits(stored.model)
    try:
        fitted = DatasetRepository(session).get(stored.body["datasets"][0])
    except StorageError:  # deleted since, so its units are unknown
        fitted = row
    before_by_signal = stored.channels.by_signal
    for signal, name in channels.by_signal.items():
        before = before_by_signal[signal]
        units.describe_mismatch(signal, before, _get_unit(fitted, before), f"{fitted.name!r}")
        fault = units.describe_mismatch(signal, name, _get_unit(row, name), f"{row.name!r}")
        if fault:
            yield FieldError(f"/channels/{signal}", fault)


def _get_unit(row: Dataset, channel: str) -> str | None:
    return next((str(entry["unit"]) for entry in row.channels if entry["name"] == channel), None)


def _read_records(store: ObjectStore, row: Dataset, channels: SignalChannels) -> tuple[Record, ...]:
    try:
        records = read_records(store, [row], channels)
    except InvalidRecord as error:
        raise InvalidRequest.from_fault("/dataset", str(error)) from None
    if len(records) > MAX_RECORDS:
        raise InvalidRequest.from_fault(
            "/dataset",
            f"{row.name!r} has {len(records)} segments; a request may have at most "
            f"{MAX_RECORDS}. Derive a dataset with fewer segments with 'select' or 'trim'",
        )
    return records


def _build_problem(stored: StoredRun, records: tuple[Record, ...], skip: int) -> "Problem":
    """Build the problem with all estimates fixed, so that at most initial states are free."""
    # This imports the compiler, which most requests never need.
    from sysid.simulation.problem import Problem

    model, request = stored.model_of_other_records, stored.body
    own_names = {parameter.name for parameter in model.parameters}
    values = {
        estimate.name: estimate for estimate in stored.estimates if estimate.name in own_names
    }
    starts = {parameter.name for parameter in build_initial_parameters(model, len(records))}
    changes = {name: f for name, f in request["parameters"].items() if name in starts}
    fixed = {name: _fix_estimate(estimate) for name, estimate in values.items()}
    weights = {
        name: float(np.sqrt(np.mean(np.square(given))))
        for name, given in (request["weights"] or {}).items()
    }
    try:
        return Problem.build(
            model, records, parameters={**changes, **fixed}, weights=weights or None, skip=skip
        )
    except (InvalidRecord, RecordTooShort) as error:
        raise InvalidRequest.from_fault("/dataset", str(error)) from None


def _fix_estimate(estimate: Estimate) -> dict[str, Any]:
    """Fix an estimate. That of a tied parameter may lie outside its bounds."""
    value = estimate.value
    bounds = [bound for bound in (estimate.lower, estimate.upper) if isfinite(bound)]
    return {
        "fixed": value,
        "scale": "linear",
        "lower": min([value, *bounds]),
        "upper": max([value, *bounds]),
    }


def _search_starts(problem: "Problem") -> FloatArray:
    """Estimate the initial states (D,) that fit best.

    Initial states affect their own record only, so each record is searched alone. A joint search
    would cost the cube of their number.
    """
    most = max(MIN_SIMULATIONS, MAX_STEPS // problem.n_steps)
    changes = problem.settings.parameters
    if len(problem.records) == 1 or any("tied" in fields for fields in changes.values()):
        return _refine_starts(problem, most)
    return np.concatenate([_refine_starts(part, most) for part in _split_by_record(problem)])


def _split_by_record(problem: "Problem") -> "Iterator[Problem]":
    """Split a problem by record. Initial states get the names of the first record."""
    model, changes = problem.untied_model, problem.settings.parameters
    fixed = {
        parameter.name: changes[parameter.name]
        for parameter in model.parameters
        if parameter.name in changes
    }
    for number, record in enumerate(problem.records):
        names = {
            name_initial_state(state.name, 0): name_initial_state(state.name, number)
            for state in model.states
        }
        starts = {
            first_name: changes[name] for first_name, name in names.items() if name in changes
        }
        yield problem.rebuild(
            records=[record],
            parameters=fixed | starts,
            weights=problem.output_weights,
            deviations=None,
        )


def _refine_starts(problem: "Problem", simulations: int) -> FloatArray:
    from sysid.search.refine import refine_candidates

    if not problem.free_parameters:
        return np.zeros(0)
    work = problem.evaluator.n_measured * len(problem.free_parameters)
    if work > MAX_WORK:
        raise InvalidRequest.from_fault(
            "/dataset",
            f"{len(problem.free_parameters)} initial states are free on "
            f"{problem.evaluator.n_measured} measured values. Their product may be at most "
            f"{MAX_WORK:.3g}. Derive a shorter recording",
        )
    middle: FloatArray = 0.5 * (problem.evaluator.lower + problem.evaluator.upper)
    refined = refine_candidates(problem, [middle], simulations)[0]
    return middle if refined is None else refined.theta


def _evaluate_free_run(problem: "Problem", run_id: str, row: Dataset) -> FreeRun:
    from sysid.simulation.problem import compute_metrics

    theta = _search_starts(problem)
    predicted = problem.predict(theta[None])[0]
    metrics = _apply_recorded_units(compute_metrics(problem, predicted), problem.records)
    if not isfinite(metrics.rms):
        raise InvalidRequest.from_fault(
            "/dataset",
            f"the simulation of {run_id} diverges on {row.name!r}. The recording exceeds the "
            "range that the model was identified on",
        )
    names = [output.name for output in problem.model.outputs]
    return FreeRun(
        run=run_id,
        dataset=row.id,
        records=problem.records,
        simulated=tuple(
            tuple(p[name] for name in names) for p in problem.split_by_output(predicted)
        ),
        metrics=metrics,
        starts=dict(zip(problem.free_names, theta.tolist(), strict=True)),
    )


def _apply_recorded_units(metrics: Metrics, records: Sequence[Record]) -> Metrics:
    """Replace the unit of outputs that may have any unit by that of the recording."""
    units = {channel.name: channel.unit for channel in records[0].outputs}
    channels = tuple(
        replace(channel, unit=units[channel.output]) if channel.unit == "1" else channel
        for channel in metrics.channels
    )
    alone = metrics.unit == "1" and len(units) == 1
    return replace(metrics, channels=channels, unit=channels[0].unit if alone else metrics.unit)


def _to_experiments_out(free_run: FreeRun, max_points: int) -> Iterator[ExperimentOut]:
    for number, (record, outputs) in enumerate(
        zip(free_run.records, free_run.simulated, strict=True), 1
    ):
        simulated = [
            Channel(channel.name, channel.times, values, channel.unit)
            for channel, values in zip(record.outputs, outputs, strict=True)
        ]
        yield ExperimentOut(
            name=f"record {number}",
            measured=[to_series(channel, max_points) for channel in record.outputs],
            simulated=[to_series(channel, max_points) for channel in simulated],
        )
