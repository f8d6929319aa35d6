"""Use case: simulate the model of a run with new inputs, or in a closed loop."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from sqlalchemy.orm import Session

from service.control.closed_loop import (
    LoopResponse,
    check_transport_delay,
    find_control_faults,
    simulate_closed_loop,
)
from service.control.schemas import ControlIn, RunSimulateIn, RunSimulationOut
from service.core.concurrency import simulation_limit
from service.core.errors import FieldError, InvalidRequest
from service.datasets.datasets import add_recording, hash_source, to_out, to_series
from service.datasets.schemas import DatasetOut
from service.datasets.simulated import check_finite_outputs, check_given_delays
from service.datasets.waveforms import InputSignals, interpolate_channel
from service.jobs.stored_run import StoredRun, load_estimated_run
from service.repositories.datasets import DatasetRepository
from service.storage.errors import StorageError
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from sysid.core.errors import suggest_name
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording
from sysid.models.model import FixedInitial, Model


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


@simulation_limit.acquire()
def simulate_run(
    database: Database, store: ObjectStore, run_id: str, body: RunSimulateIn, max_points: int
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
    with database.read_session() as session:
        asked = _read_request(session, store, run_id, body)
    loop = _simulate_loop(asked, body.control) if body.control else None
    found = _SimulationResult(
        outputs=_simulate_open_loop(asked) if loop is None else loop.outputs,
        inputs=[_sample_channel(one, asked.times) for one in asked.inputs]
        + _list_plant_inputs(loop),
        notes=[*asked.notes, *(loop.notes if loop else ())],
    )
    reference = None if asked.reference is None else _sample_channel(asked.reference, asked.times)
    dataset = (
        _store_simulation(database, store, run_id, body, asked, found, reference)
        if body.store
        else None
    )
    return RunSimulationOut.from_source(
        loop,
        id=run_id,
        parameters=asked.values,
        outputs=[to_series(one, max_points) for one in found.outputs],
        inputs=[to_series(one, max_points) for one in found.inputs],
        reference=None if reference is None else to_series(reference, max_points),
        command=to_series(loop.command, max_points) if loop else None,
        notes=found.notes,
        dataset=dataset,
    )


def _read_request(
    session: Session, store: ObjectStore, run_id: str, body: RunSimulateIn
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
        signals.build_channel(f"/inputs/{one.name}", one.name, one.unit, body.inputs[one.name])
        for one in model.inputs
        if one.name in body.inputs
    ]
    reference = None
    if body.control is not None:
        unit = next((o.unit for o in model.outputs if o.name == body.control.output), "1")
        at = "/control/reference"
        reference = signals.build_channel(at, "reference", unit, body.control.reference)
    values = _collect_values(stored, body.parameters)
    given = inputs if reference is None else [*inputs, reference]
    notes = [*notes, *_describe_early_inputs(model, given, period)]
    return _SimulationRequest(model, values, times, inputs, reference, signals.parents, notes)


def _describe_early_inputs(model: Model, given: Sequence[Channel], period: float) -> list[str]:
    """Report signals from before t = 0. The solver begins where the first of them begins."""
    first = min(given, key=lambda one: float(one.times[0]), default=None)
    if first is None or model.form != "differential" or first.times[0] > -0.5 * period:
        return []
    return [
        f"{first.name} begins at {float(first.times[0]):.6g} s. The initial states apply there, "
        "not at t = 0"
    ]


def _choose_sample_time(
    session: Session, stored: StoredRun, body: RunSimulateIn
) -> tuple[float, list[str]]:
    """Choose the sampling period in s, with notes about it."""
    try:
        known = DatasetRepository(session).get(stored.body["datasets"][0]).sample_time
    except StorageError:  # deleted since; the run can still be simulated
        known = None
    period = body.sample_time or known
    if period is None:
        raise InvalidRequest.from_fault(
            "/sample_time", "is missing, and the run's data do not give one. Give it in s"
        )
    form = stored.model.form
    if form == "differential" or known is None or abs(period / known - 1) < 1e-3:
        return period, []
    if form == "polynomial":
        raise InvalidRequest.from_fault(
            "/sample_time",
            f"found {period:g} s, but the terms of this polynomial are samples at {known:g} s. "
            "Leave it out",
        )
    return period, [
        f"the model is a recursion identified at a sample time of {known:.6g} s. At "
        f"{period:.6g} s it is another approximation"
    ]


def _collect_values(stored: StoredRun, given: Mapping[str, float]) -> dict[str, float]:
    """Collect the values of all parameters and of all initial states that the model leaves open."""
    model = stored.model
    rest = {
        f"{state.name}(0)": 0.0
        for state, start in zip(model.states, model.initial, strict=True)
        if not isinstance(start, FixedInitial)
    }
    own = {parameter.name for parameter in model.parameters}
    found = {p["name"]: p["value"] for p in stored.estimates if p["name"] in own}
    # A tied parameter follows its expression, unless the request gives it a value.
    tied = {p["name"] for p in stored.estimates if p["status"] == "tied"} if given else set()
    by_document = {p.name for p in model.parameters if p.tied is not None}
    kept = {name: value for name, value in found.items() if name not in tied & by_document}
    return {**rest, **kept, **given}


def _simulate_open_loop(asked: _SimulationRequest) -> list[Channel]:
    # This imports the compiler, which most requests never need.
    from sysid.simulation.simulate import simulate as simulated

    found = simulated(asked.model, asked.inputs, asked.values, times=asked.times).channels
    check_finite_outputs(found, asked.times)
    return list(found)


def _simulate_loop(asked: _SimulationRequest, control: ControlIn) -> LoopResponse:
    assert asked.reference is not None
    return simulate_closed_loop(
        asked.model, asked.values, asked.times, asked.reference, asked.inputs, control
    )


def _list_plant_inputs(loop: LoopResponse | None) -> list[Channel]:
    return [] if loop is None else [loop.plant_input]


def _sample_channel(channel: Channel, times: FloatArray) -> Channel:
    return replace(channel, times=times, values=interpolate_channel(channel, times), history=None)


def _store_simulation(
    database: Database,
    store: ObjectStore,
    run_id: str,
    body: RunSimulateIn,
    asked: _SimulationRequest,
    found: _SimulationResult,
    reference: Channel | None,
) -> DatasetOut:
    """Store the simulation as a dataset of its run. The same request gives the same dataset."""
    request = body.model_dump(mode="json", exclude={"name", "store"})
    key = hash_source({"run": run_id, "simulation": request, "values": asked.values})
    with database.read_session() as session:
        known = DatasetRepository(session).find_by_source(key)
    if known is not None:
        return to_out(known)
    channels = [*found.inputs, *found.outputs]
    taken = {channel.name for channel in channels}
    if reference is not None and reference.name not in taken:
        channels.append(reference)
    details = {
        "run": run_id,
        "simulation": request,
        "true_parameters": asked.values,
        "warnings": found.notes,
    }
    stored = add_recording(
        database,
        store,
        Recording(tuple(channels)),
        name=body.name or f"{asked.model.name}, simulated with {run_id}",
        kind="simulate",
        key=key,
        details=details,
        parents=[run_id, *asked.parents],
        relation="simulated",
    )
    return to_out(stored.dataset)


def _find_parameter_faults(model: Model, values: Mapping[str, float]) -> Iterator[FieldError]:
    known = [*(p.name for p in model.parameters), *(f"{one.name}(0)" for one in model.states)]
    for name in values:
        if name not in known:
            detail = f"the model has no parameter {name!r}{suggest_name(name, known)}"
            yield FieldError(f"/parameters/{name}", detail)


def _find_input_faults(model: Model, body: RunSimulateIn) -> Iterator[FieldError]:
    known = [one.name for one in model.inputs]
    controlled = body.control.input if body.control else None
    if body.control is not None:
        found = list(find_control_faults(model, body.control))
        yield from found
        if found:  # the missing inputs are unknown then
            return
    for name in body.inputs:
        if name not in known:
            detail = f"the model has no input {name!r}{suggest_name(name, known)}"
            yield FieldError(f"/inputs/{name}", detail)
        elif name == controlled:
            yield FieldError(f"/inputs/{name}", "the controller computes this input. Leave it out")
    for name in known:
        if name not in body.inputs and name != controlled:
            yield FieldError(
                f"/inputs/{name}",
                f"input {name!r} is missing. Give a signal, such as "
                '{"kind": "step", "amplitude": 1}, or close the loop with "control"',
            )
