"""Use case: simulate the model of a run with new inputs, or in a closed loop."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from sqlalchemy.orm import Session

from service.control.control_schemas import ControlIn, RunSimulationIn, RunSimulationOut
from service.control.loop_answer import (
    LoopResponse,
    Simulate,
    check_transport_delay,
    find_control_faults,
    simulate_closed_loop,
)
from service.core.errors import FieldError, InvalidRequest
from service.core.process.concurrency import ReaderPlaces
from service.datasets.dataset_schemas import DatasetOut
from service.datasets.datasets import (
    add_recording,
    find_existing,
    hash_source,
    to_out,
    to_series,
)
from service.datasets.large_simulation import check_finite_outputs, simulate_outputs
from service.datasets.simulated import check_given_delays
from service.datasets.waveforms import InputSignals, interpolate_channel
from service.jobs.stored_run import StoredRun, load_estimated_run
from service.queue.daily_limit import compute_on_request
from service.repositories.dataset_rows import DatasetRepository
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from service.storage.storage_errors import StorageError
from sysid.core.errors import suggest_name
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording
from sysid.models.model import DerivedInitial, FixedInitial, Model


@dataclass(frozen=True, slots=True)
class _SimulationRequest:
    """Simulation request with model, values and signals resolved."""

    model: Model
    values: dict[str, float]
    times: FloatArray
    inputs: list[Channel]
    reference: Channel | None
    parents: list[str]
    notes: list[str]


@dataclass(frozen=True, slots=True)
class _SimulationResult:
    """Simulated signals, and notes about them."""

    outputs: list[Channel]
    inputs: list[Channel]
    notes: list[str]


def simulate_run(
    database: Database,
    store: ObjectStore,
    readers: ReaderPlaces,
    run_id: str,
    body: RunSimulationIn,
    max_points: int,
) -> RunSimulationOut:
    """Simulate a run's model. With `store` the result becomes a dataset.

    Raises
    ------
    NotFound
        If there is no such run or dataset.
    Conflict
        If the run has no estimates.
    InvalidRequest
        With every fault of the inputs and parameters, or where the simulation diverges.
    """
    with compute_on_request(database):
        return _simulate_run(database, store, readers, run_id, body, max_points)


def _simulate_run(
    database: Database,
    store: ObjectStore,
    readers: ReaderPlaces,
    run_id: str,
    body: RunSimulationIn,
    max_points: int,
) -> RunSimulationOut:
    with database.read_session() as session:
        request = _read_request(session, store, run_id, body)
    simulate = partial(simulate_outputs, readers=readers, project=database.owner.project_id)
    loop = _simulate_loop(request, body.control, simulate) if body.control else None
    result = _SimulationResult(
        outputs=_simulate_open_loop(request, simulate) if loop is None else loop.outputs,
        inputs=[
            *(_sample_channel(channel, request.times) for channel in request.inputs),
            *([] if loop is None else [loop.plant_input]),
        ],
        notes=[*request.notes, *(loop.notes if loop else ())],
    )
    reference = (
        None if request.reference is None else _sample_channel(request.reference, request.times)
    )
    dataset = (
        _store_simulation(database, store, run_id, body, request, result, reference)
        if body.store
        else None
    )
    return RunSimulationOut(
        id=run_id,
        parameters=request.values,
        outputs=[to_series(channel, max_points) for channel in result.outputs],
        inputs=[to_series(channel, max_points) for channel in result.inputs],
        reference=None if reference is None else to_series(reference, max_points),
        command=to_series(loop.command, max_points) if loop else None,
        metrics=loop.metrics if loop else None,
        controller=loop.controller if loop else None,
        tuning=loop.tuning if loop else None,
        margins=loop.margins if loop else None,
        notes=result.notes,
        dataset=dataset,
    )


def _read_request(
    session: Session, store: ObjectStore, run_id: str, body: RunSimulationIn
) -> _SimulationRequest:
    stored = load_estimated_run(session, run_id, "simulate with")
    model = stored.model
    faults = [*_find_parameter_faults(model, body.parameters), *_find_input_faults(model, body)]
    if faults:
        raise InvalidRequest(faults)
    check_given_delays(model, body.parameters)
    period, notes = _choose_sample_time(session, stored, body)
    times = np.arange(body.samples, dtype=np.float64) * period
    check_transport_delay(body.control, float(times[-1]))
    signals = InputSignals(session, store, times)
    inputs = [
        signals.build_channel(
            f"/inputs/{signal.name}", signal.name, signal.unit, body.inputs[signal.name]
        )
        for signal in model.inputs
        if signal.name in body.inputs
    ]
    reference = None
    if body.control is not None:
        unit = next((o.unit for o in model.outputs if o.name == body.control.output), "1")
        pointer = "/control/reference"
        reference = signals.build_channel(pointer, "reference", unit, body.control.reference)
    values = _collect_values(stored, body.parameters)
    channels = inputs if reference is None else [*inputs, reference]
    notes = [*notes, *_describe_early_inputs(model, channels, period)]
    return _SimulationRequest(model, values, times, inputs, reference, signals.parents, notes)


def _describe_early_inputs(model: Model, signals: Sequence[Channel], period: float) -> list[str]:
    """Report signals from before t = 0. The solver begins where the first of them begins."""
    first = min(signals, key=lambda channel: float(channel.times[0]), default=None)
    if first is None or model.form != "differential" or first.times[0] > -0.5 * period:
        return []
    return [
        f"{first.name} begins at {float(first.times[0]):.6g} s. The initial states apply there, "
        "not at t = 0"
    ]


def _choose_sample_time(
    session: Session, stored: StoredRun, body: RunSimulationIn
) -> tuple[float, list[str]]:
    """Choose the sampling period in s, with notes about it."""
    try:
        recorded = DatasetRepository(session).get(stored.body["datasets"][0]).sample_time
    except StorageError:  # deleted since; the run can still be simulated
        recorded = None
    period = body.sample_time or recorded
    if period is None:
        raise InvalidRequest.from_fault(
            "/sample_time", "is missing, and the run's data do not give one. Give it in s"
        )
    form = stored.model.form
    if form == "differential" or recorded is None or abs(period / recorded - 1) < 1e-3:
        return period, []
    if form == "polynomial":
        raise InvalidRequest.from_fault(
            "/sample_time",
            f"found {period:g} s, but the terms of this polynomial are samples at {recorded:g} s. "
            "Leave it out",
        )
    return period, [
        f"the model is a recursion identified at a sample time of {recorded:.6g} s. At "
        f"{period:.6g} s it is another approximation"
    ]


def _collect_values(stored: StoredRun, changes: Mapping[str, float]) -> dict[str, float]:
    """Collect the values of all parameters and of all initial states that the model leaves open."""
    model = stored.model
    rest = {
        f"{state.name}(0)": 0.0
        for state, start in zip(model.states, model.initial, strict=True)
        if not isinstance(start, FixedInitial | DerivedInitial)
    }
    names = {parameter.name for parameter in model.parameters}
    estimates = {p.name: p.value for p in stored.estimates if p.name in names}
    # A tied parameter follows its expression, unless the request gives it a value.
    tied = {p.name for p in stored.estimates if p.status == "tied"} if changes else set()
    by_document = {p.name for p in model.parameters if p.tied is not None}
    untied = {name: value for name, value in estimates.items() if name not in tied & by_document}
    return {**rest, **untied, **changes}


def _simulate_open_loop(request: _SimulationRequest, simulate: Simulate) -> list[Channel]:
    outputs = simulate(request.model, request.inputs, request.values, request.times).channels
    check_finite_outputs(outputs, request.times)
    return list(outputs)


def _simulate_loop(
    request: _SimulationRequest, control: ControlIn, simulate: Simulate
) -> LoopResponse:
    assert request.reference is not None
    return simulate_closed_loop(
        request.model,
        request.values,
        request.times,
        request.reference,
        request.inputs,
        control,
        simulate,
    )


def _sample_channel(channel: Channel, times: FloatArray) -> Channel:
    return replace(
        channel, times=times, values=interpolate_channel(channel, times), history=None, repeats=None
    )


def _store_simulation(
    database: Database,
    store: ObjectStore,
    run_id: str,
    body: RunSimulationIn,
    resolved: _SimulationRequest,
    result: _SimulationResult,
    reference: Channel | None,
) -> DatasetOut:
    """Store the simulation as a dataset of its run. The same request gives the same dataset."""
    request = body.model_dump(mode="json", exclude={"name", "store"})
    key = hash_source({"run": run_id, "simulation": request, "values": resolved.values})
    with database.read_session() as session:
        existing = find_existing(session, store, key)
    if existing is not None:
        return to_out(existing)
    channels = [*result.inputs, *result.outputs]
    taken = {channel.name for channel in channels}
    if reference is not None and reference.name not in taken:
        channels.append(reference)
    details = {
        "run": run_id,
        "simulation": request,
        "true_parameters": resolved.values,
        "warnings": result.notes,
    }
    stored = add_recording(
        database,
        store,
        Recording(tuple(channels)),
        name=body.name or f"{resolved.model.name}, simulated with {run_id}",
        kind="simulate",
        key=key,
        details=details,
        parents=[run_id, *resolved.parents],
        relation="simulated",
    )
    return to_out(stored.dataset)


def _find_parameter_faults(model: Model, values: Mapping[str, float]) -> Iterator[FieldError]:
    names = [*(p.name for p in model.parameters), *(f"{state.name}(0)" for state in model.states)]
    for name in values:
        if name not in names:
            detail = f"the model has no parameter {name!r}{suggest_name(name, names)}"
            yield FieldError(f"/parameters/{name}", detail)


def _find_input_faults(model: Model, body: RunSimulationIn) -> Iterator[FieldError]:
    inputs = [signal.name for signal in model.inputs]
    controlled = body.control.input if body.control else None
    if body.control is not None:
        faults = list(find_control_faults(model, body.control))
        yield from faults
        if faults:  # the missing inputs are unknown then
            return
    for name in body.inputs:
        if name not in inputs:
            detail = f"the model has no input {name!r}{suggest_name(name, inputs)}"
            yield FieldError(f"/inputs/{name}", detail)
        elif name == controlled:
            yield FieldError(f"/inputs/{name}", "the controller computes this input. Leave it out")
    for name in inputs:
        if name not in body.inputs and name != controlled:
            yield FieldError(
                f"/inputs/{name}",
                f"input {name!r} is missing. Give a signal, such as "
                '{"kind": "step", "amplitude": 1}, or close the loop with "control"',
            )
