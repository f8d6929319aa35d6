"""Use case: a dataset simulated from a reference plant, which is finer than its models."""

from dataclasses import fields
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest
from service.datasets.dataset_schemas import SimulateIn
from service.datasets.datasets import add_recording, find_existing, hash_source
from service.datasets.waveforms import InputSignals
from service.repositories.dataset_rows import StoredDataset
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from sysid.core.errors import InvalidRecord, suggest_name
from sysid.data.records import Channel, Recording

_SUPPLY_EXAMPLE = '{"kind": "binary", "amplitude": 12e3, "period": 0.2}'
_TUBE_OPTIONS = ("pattern", "gauges")
_INTEGER_PARAMETERS = ("pattern", "gauges", "cells", "modes")


def simulate_plant(database: Database, store: ObjectStore, body: SimulateIn) -> StoredDataset:
    """Simulate the inputs and outputs of a plant; the same body returns the same dataset.

    Raises
    ------
    InvalidRequest
        With every fault of its parameters and inputs.
    """
    key = hash_source(body.model_dump(mode="json", exclude={"name"}))
    with database.read_session() as session:
        existing = find_existing(session, store, key)
        if existing is not None:
            return StoredDataset(existing, is_new=False)
        if body.plant == "tube":
            supply: Channel | None = None
            parents: list[str] = []
        else:
            supply, parents = _build_supply(session, store, body)
    # The simulation takes time: no transaction is open meanwhile.
    recording, true_parameters = (
        _simulate_tube(body) if supply is None else _simulate_actuator(body, supply)
    )
    details = {
        "simulation": body.model_dump(mode="json", exclude={"model"}),
        "true_parameters": true_parameters,
        "warnings": [],
    }
    return add_recording(
        database,
        store,
        _add_noise(recording, body),
        name=body.name or f"{body.plant}, simulated",
        kind="simulate",
        key=key,
        details=details,
        parents=parents,
        relation="simulated",
    )


def _build_supply(
    session: Session, store: ObjectStore, body: SimulateIn
) -> tuple[Channel, list[str]]:
    """Build the supply pressure of the actuator; also return the datasets that it comes from."""
    faults = [
        FieldError(f"/inputs/{name}", "the actuator has one input, P_a")
        for name in body.inputs
        if name != "P_a"
    ]
    if "P_a" not in body.inputs:
        faults.append(
            FieldError("/inputs/P_a", f"give input 'P_a' in Pa, such as {_SUPPLY_EXAMPLE}")
        )
    if body.samples is None or body.sample_time is None:
        missing = "samples" if body.samples is None else "sample_time"
        faults.append(FieldError(f"/{missing}", "is missing; the actuator has no default"))
    if faults:
        raise InvalidRequest(faults)
    times = np.arange(body.samples or 0, dtype=np.float64) * (body.sample_time or 0.0)
    signals = InputSignals(session, store, times)
    supply = signals.sample_input("/inputs/P_a", "P_a", "Pa", body.inputs["P_a"])
    return supply, signals.parents


def _simulate_actuator(body: SimulateIn, supply: Channel) -> tuple[Recording, dict[str, float]]:
    from service.plants.actuator import Actuator, simulate_actuator

    parameters = _check_parameters(Actuator, (), body.parameters)
    if "k_a" in parameters and "k_b" not in parameters:
        parameters["k_b"] = parameters["k_a"]  # because P settles at P_a
    actuator = Actuator(**parameters)
    try:
        recording = simulate_actuator(actuator, supply)
    except InvalidRecord as error:
        raise InvalidRequest.from_fault("/samples", str(error)) from None
    return recording, _read_parameters(actuator)


def _simulate_tube(body: SimulateIn) -> tuple[Recording, dict[str, float]]:
    from service.plants.tube import Tube, add_gauge_errors, simulate_tube_record

    if body.inputs:
        raise InvalidRequest.from_fault(
            f"/inputs/{next(iter(body.inputs))}",
            "the tube is driven by its regulator; choose the parameter 'pattern', 1 or 2",
        )
    parameters = _check_parameters(Tube, _TUBE_OPTIONS, body.parameters)
    options = {name: parameters.pop(name) for name in _TUBE_OPTIONS if name in parameters}
    tube = Tube(**parameters)
    period = body.sample_time or (0.002 if tube.length_m <= 10 else 0.01)
    duration = 30.0 * max(1.0, tube.length_m / 40.0)
    samples = body.samples or round(duration / period) + 1
    pattern = options.get("pattern", 1)
    recording = simulate_tube_record(tube, pattern, samples, period)
    if "gauges" in options:
        recording = add_gauge_errors(recording, options["gauges"])
    return recording, {**_read_parameters(tube), "pattern": pattern}


def _check_parameters(
    kind: Any, extra: tuple[str, ...], values: dict[str, float]
) -> dict[str, Any]:
    """Check the parameters of a plant, and convert the whole numbers."""
    valid_names = [*(field.name for field in fields(kind)), *extra]
    faults = []
    for name, value in values.items():
        if name not in valid_names:
            detail = f"the plant has no parameter {name!r}{suggest_name(name, valid_names)}"
            faults.append(FieldError(f"/parameters/{name}", detail))
        elif name in _INTEGER_PARAMETERS and (value != int(value) or value < 0):
            detail = f"found {value:g}; need a whole number, 0 or more"
            faults.append(FieldError(f"/parameters/{name}", detail))
    if faults:
        raise InvalidRequest(faults)
    return {name: int(v) if name in _INTEGER_PARAMETERS else v for name, v in values.items()}


def _read_parameters(plant: Any) -> dict[str, float]:
    return {field.name: getattr(plant, field.name) for field in fields(plant)}


def _add_noise(recording: Recording, body: SimulateIn) -> Recording:
    """Add noise to the output: the angle of the actuator, the far end of the tube."""
    if body.noise.sigma == 0:
        return recording
    from sysid.data.derivations import derive_recording

    output = "theta" if body.plant == "actuator" else "P2"
    return derive_recording(
        recording, [{"noise": {**body.noise.model_dump(), "channels": [output]}}]
    )
