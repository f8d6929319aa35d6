"""Use case: the model of a run simulated on new inputs, or in a loop that is closed around it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.datasets import add_recording, key_of, series, told
from service.errors import Conflict, FieldError, InvalidRequest
from service.inputs import Signals, sampled
from service.models import model_of_run
from service.schemas_datasets import DatasetOut, StepInput
from service.schemas_simulations import (
    ControlIn,
    RunSimulateIn,
    RunSimulationOut,
    StepMetricsOut,
)
from service.simulations import check_finite, check_lags_at
from service.storage.datasets import DatasetRepository
from service.storage.errors import StorageError
from service.storage.jobs import JobRepository
from service.storage.objects import ObjectStore
from service.storage.runs import RunRepository
from service.storage.sessions import Database
from service.storage.tables import Run
from service.sweeps import body_of
from service.turns import simulating
from sysid.errors import InvalidSettings, nearest
from sysid.models.model import FixedInitial, Model
from sysid.records import Channel, Recording
from sysid.types import FloatArray

_SMALL = 0.02  # of a step: what moves or differs by less is at rest
_MORE = (
    "the measures tell of how it settles too, not of the step alone; give the states' starts, "
    "such as x(0), or a later step"
)


@dataclass(frozen=True, slots=True)
class _Asked:
    """What a request asks of a run, looked up."""

    model: Model
    values: dict[str, float]
    times: FloatArray
    inputs: list[Channel]
    reference: Channel | None
    parents: list[str]
    notes: list[str]


@dataclass(frozen=True, slots=True)
class _Simulated:
    """What the model does: its outputs, and in a loop what the controller gives."""

    outputs: list[Channel]
    inputs: list[Channel]
    command: Channel | None
    notes: list[str]


@simulating.one()
def simulate(
    database: Database, store: ObjectStore, run_id: str, body: RunSimulateIn, max_points: int
) -> RunSimulationOut:
    """Simulate a run's model; with `store`, what comes out becomes a dataset.

    Raises
    ------
    NotFound
        If there is no such run or dataset.
    Conflict
        If the run has no estimates.
    InvalidRequest
        With every fault of the inputs and parameters, or where the simulation diverges.
    """
    with database.read() as session:
        asked = _asked(session, store, run_id, body)
    found = _closed(asked, body.control) if body.control else _open(asked)
    _check_finite(found, asked, body.control)
    reference = _sampled(asked.reference, asked.times)
    dataset = _stored(database, store, run_id, body, asked, found) if body.store else None
    return RunSimulationOut(
        id=run_id,
        parameters=asked.values,
        outputs=[series(one, max_points) for one in found.outputs],
        inputs=[series(one, max_points) for one in found.inputs],
        reference=None if reference is None else series(reference, max_points),
        command=None if found.command is None else series(found.command, max_points),
        metrics=_metrics(asked.times, found.outputs, body.control),
        notes=[*asked.notes, *found.notes, *_start_notes(asked.times, found.outputs, body.control)],
        dataset=dataset,
    )


def _asked(session: Session, store: ObjectStore, run_id: str, body: RunSimulateIn) -> _Asked:
    run = RunRepository(session).get(run_id)
    if run.result is None or not run.result.get("parameters"):
        raise Conflict(f"run {run_id} is {run.state.value} and has no estimates to simulate with")
    job = JobRepository(session).get(run.job_id)
    model = model_of_run(session, run, job)
    faults = [*_parameter_faults(model, body.parameters), *_input_faults(model, body)]
    if faults:
        raise InvalidRequest(faults)
    check_lags_at(model, body.parameters)
    period, notes = _period(session, model, body_of(job.spec, run.cell), body)
    times = np.arange(body.samples, dtype=np.float64) * period
    _check_transport(body.control, float(times[-1]))
    signals = Signals(session, store, times)
    inputs = [
        signals.channel(f"/inputs/{one.name}", one.name, one.unit, body.inputs[one.name])
        for one in model.inputs
        if one.name in body.inputs
    ]
    reference = None
    if body.control is not None:
        unit = next((o.unit for o in model.outputs if o.name == body.control.output), "1")
        at = "/control/reference"
        reference = signals.channel(at, "reference", unit, body.control.reference)
    values = _values(model, run, body.parameters)
    given = inputs if reference is None else [*inputs, reference]
    notes = [*notes, *_early_notes(model, given, period)]
    return _Asked(model, values, times, inputs, reference, signals.parents, notes)


def _early_notes(model: Model, given: Sequence[Channel], period: float) -> list[str]:
    """What to say of signals from before t = 0: the solver begins where the first of them does."""
    first = min(given, key=lambda one: float(one.times[0]), default=None)
    if first is None or model.form != "differential" or first.times[0] > -0.5 * period:
        return []
    return [
        f"{first.name} is given from {float(first.times[0]):.6g} s on: there the states start, not "
        "at t = 0, with the values that are told for it"
    ]


def _period(
    session: Session, model: Model, job: Mapping[str, Any], body: RunSimulateIn
) -> tuple[float, list[str]]:
    """The sampling period in s, and what is to be said of it."""
    try:
        known = DatasetRepository(session).get(job["datasets"][0]).sample_time
    except StorageError:  # it was deleted since; the run can still be simulated
        known = None
    period = body.sample_time or known
    if period is None:
        raise InvalidRequest.at(
            "/sample_time", "is missing, and the run's data do not tell one; give it in s"
        )
    if model.form == "differential" or known is None or abs(period / known - 1) < 1e-3:
        return period, []
    if model.form == "polynomial":
        raise InvalidRequest.at(
            "/sample_time",
            f"found {period:g} s; the terms of this polynomial are samples of {known:g} s: "
            "leave it out",
        )
    return period, [
        f"the model is a recursion that was identified at {known:.6g} s; at {period:.6g} s it is "
        "another approximation"
    ]


def _values(model: Model, run: Run, given: Mapping[str, float]) -> dict[str, float]:
    """Value of every parameter and of every start that the model does not fix."""
    rest = {
        f"{state.name}(0)": 0.0
        for state, start in zip(model.states, model.initial, strict=True)
        if not isinstance(start, FixedInitial)
    }
    own = {parameter.name for parameter in model.parameters}
    result = run.result or {}
    found = {p["name"]: p["value"] for p in result["parameters"] if p["name"] in own}
    # What is tied follows the parameters it is tied to, unless a value is given for itself.
    tied = {p["name"] for p in result["parameters"] if p["status"] == "tied"} if given else set()
    by_document = {p.name for p in model.parameters if p.tied is not None}
    kept = {name: value for name, value in found.items() if name not in tied & by_document}
    return {**rest, **kept, **given}


def _open(asked: _Asked) -> _Simulated:
    # The compiler comes with this import, and most requests never need it.
    from sysid.simulation import simulate as simulated

    outputs = simulated(asked.model, asked.inputs, asked.values, times=asked.times).channels
    inputs = [one for c in asked.inputs if (one := _sampled(c, asked.times)) is not None]
    return _Simulated(list(outputs), inputs, None, [])


def _closed(asked: _Asked, control: ControlIn) -> _Simulated:
    from sysid.closed_loop import ProportionalControl, Transport, close_loop
    from sysid.simulation import simulate as simulated

    transport = None if control.transport is None else Transport(**control.transport.model_dump())
    solver = asked.model.solver
    step = (solver.step or float(asked.times[1] - asked.times[0])) / solver.substeps
    try:
        loop = close_loop(
            asked.model,
            ProportionalControl(
                control.input, control.output, control.gain, control.limit, transport
            ),
            step,
        )
    except InvalidSettings as error:
        raise InvalidRequest.at(f"/control{error.pointer}", error.detail) from None
    assert asked.reference is not None
    given = [replace(asked.reference, name=loop.reference), *asked.inputs]
    found = simulated(loop.model, given, loop.values(asked.values), times=asked.times)
    outputs = [found.channel(one.name) for one in asked.model.outputs]
    inputs = [one for c in asked.inputs if (one := _sampled(c, asked.times)) is not None]
    inputs.append(found.channel(loop.input))
    notes = []
    if loop.steps_late:
        notes.append(
            f"the output answers at once, so the controller acts {step:.4g} s late, as a sampled "
            "one does"
        )
    return _Simulated(outputs, inputs, found.channel(loop.command), notes)


def _check_finite(found: _Simulated, asked: _Asked, control: ControlIn | None) -> None:
    """Refuse a simulation that diverges; of a loop the gain is to blame, not the parameters."""
    try:
        check_finite(found.outputs, asked.times)
    except InvalidRequest as error:
        if control is None:
            raise
        [fault] = error.errors
        detail = fault.detail.removeprefix("with these values ").partition("; ")[0]
        raise InvalidRequest.at(
            "/control/gain",
            f"found {control.gain:g}; with it the loop runs away: {detail}; choose a smaller "
            "gain, a limit, or another sign",
        ) from None


def _sampled(channel: Channel | None, times: FloatArray) -> Channel | None:
    if channel is None:
        return None
    return replace(channel, times=times, values=sampled(channel, times), history=None)


def _metrics(
    times: FloatArray, outputs: Sequence[Channel], control: ControlIn | None
) -> StepMetricsOut | None:
    """Judge the controlled output, if the reference is a step."""
    from sysid.step_response import step_metrics

    if control is None or not isinstance(control.reference, StepInput):
        return None
    step = control.reference
    if step.amplitude == 0 or np.count_nonzero(times >= step.time) < 2:
        return None
    [output] = [one for one in outputs if one.name == control.output]
    found = step_metrics(
        times, output.values, at=step.time, before=step.offset, after=step.offset + step.amplitude
    )

    def known(value: float) -> float | None:
        return value if isfinite(value) else None

    return StepMetricsOut(
        output=output.name, unit=output.unit, rise_time=known(found.rise_time),
        overshoot_percent=known(found.overshoot_percent),
        overshoot_of_final_percent=known(found.overshoot_of_final_percent),
        settling_time=known(found.settling_time), band=found.band,
        steady_error=known(found.steady_error), final_value=known(found.final_value),
        runs_away=found.runs_away, is_settled=found.is_settled,
    )  # fmt: skip


def _start_notes(
    times: FloatArray, outputs: Sequence[Channel], control: ControlIn | None
) -> list[str]:
    """What to mind where the loop may not be at rest when its reference steps."""
    if control is None or not isinstance(control.reference, StepInput):
        return []
    step = control.reference
    [output] = [one for one in outputs if one.name == control.output]
    band, earlier = _SMALL * abs(step.amplitude), output.values[times < step.time]
    if earlier.size:
        if np.ptp(earlier[-max(earlier.size // 4, 2) :]) <= band:
            return []
        return [f"{output.name} still moves when the reference steps: {_MORE}"]
    start = float(output.values[0])
    if abs(start - step.offset) <= band:
        return []
    unit = "" if output.unit == "1" else f" {output.unit}"
    return [
        f"{output.name} starts at {start:.4g}{unit} with a reference of {step.offset:.4g}{unit} "
        f"before the step: unless the loop rests there, {_MORE}"
    ]


def _stored(
    database: Database, store: ObjectStore, run_id: str, body: RunSimulateIn, asked: _Asked,
    found: _Simulated,
) -> DatasetOut:  # fmt: skip
    """The simulation as a dataset that knows its run; the same request gives the same one."""
    request = body.model_dump(mode="json", exclude={"name", "store"})
    key = key_of({"run": run_id, "simulation": request, "values": asked.values})
    with database.read() as session:
        known = DatasetRepository(session).by_source(key)
    if known is not None:
        return told(known)
    reference = _sampled(asked.reference, asked.times)
    channels = [*found.inputs, *found.outputs]
    taken = {channel.name for channel in channels}
    if reference is not None and reference.name not in taken:
        channels.append(reference)
    details = {"run": run_id, "simulation": request, "true_parameters": asked.values,
               "warnings": [*asked.notes, *found.notes]}  # fmt: skip
    stored = add_recording(
        database, store, Recording(tuple(channels)),
        name=body.name or f"{asked.model.name}, simulated with {run_id}", kind="simulate",
        key=key, details=details, parents=[run_id, *asked.parents], relation="simulated",
    )  # fmt: skip
    return told(stored.dataset)


def _parameter_faults(model: Model, values: Mapping[str, float]) -> Iterator[FieldError]:
    known = [*(p.name for p in model.parameters), *(f"{one.name}(0)" for one in model.states)]
    for name in values:
        if name not in known:
            detail = f"the model has no parameter {name!r}{nearest(name, known)}"
            yield FieldError(f"/parameters/{name}", detail)


def _control_faults(model: Model, control: ControlIn) -> Iterator[FieldError]:
    for role, name, signals in (
        ("input", control.input, [one.name for one in model.inputs]),
        ("output", control.output, [one.name for one in model.outputs]),
    ):
        if name not in signals:
            detail = f"the model has no {role} {name!r}{nearest(name, signals)}"
            yield FieldError(f"/control/{role}", detail)


def _check_transport(control: ControlIn | None, duration: float) -> None:
    if control is not None and control.transport is not None:
        delay = control.transport.delay
        if delay >= duration:
            raise InvalidRequest.at(
                "/control/transport/delay",
                f"found {delay:g} s; the simulation lasts {duration:g} s, give more samples or a "
                "shorter delay",
            )


def _input_faults(model: Model, body: RunSimulateIn) -> Iterator[FieldError]:
    known = [one.name for one in model.inputs]
    controlled = body.control.input if body.control else None
    if body.control is not None:
        found = list(_control_faults(model, body.control))
        yield from found
        if found:  # which inputs are still to be given is not known then
            return
    for name in body.inputs:
        if name not in known:
            detail = f"the model has no input {name!r}{nearest(name, known)}"
            yield FieldError(f"/inputs/{name}", detail)
        elif name == controlled:
            yield FieldError(f"/inputs/{name}", "the controller gives this input; leave it out")
    for name in known:
        if name not in body.inputs and name != controlled:
            yield FieldError(
                f"/inputs/{name}",
                f"give input {name!r}, such as "
                '{"kind": "step", "amplitude": 1}, or close the loop with "control"',
            )
