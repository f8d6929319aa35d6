"""Use case: a dataset simulated from a reference plant, which is finer than any model of it."""

from dataclasses import fields
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest
from service.datasets.datasets import add_recording, hash_source
from service.datasets.schemas import SimulateIn
from service.datasets.waveforms import InputSignals
from service.repositories.datasets import DatasetRepository, StoredDataset
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from sysid.core.errors import InvalidRecord, suggest_name
from sysid.data.records import Channel, Recording

_SUPPLY_EXAMPLE = '{"kind": "binary", "amplitude": 12e3, "period": 0.2}'
_TUBE_OPTIONS = ("pattern", "gauges")
_INTEGER_PARAMETERS = ("pattern", "gauges", "cells", "modes")


def simulate_plant(database: Database, store: ObjectStore, body: SimulateIn) -> StoredDataset:
    """Make a dataset of a plant's inputs and outputs; the same body gives the same dataset.

    Raises
    ------
    InvalidRequest
        With every fault of its parameters and inputs.
    """
    key = hash_source(body.model_dump(mode="json", exclude={"name"}))
    with database.read_session() as session:
        known = DatasetRepository(session).find_by_source(key)
        if known is not None:
            return StoredDataset(known, is_new=False)
        if body.plant == "tube":
            supply: Channel | None = None
            parents: list[str] = []
        else:
            supply, parents = _build_supply(session, store, body)
    # The simulation takes its time: no transaction is open meanwhile.
    recording, used = _simulate_tube(body) if supply is None else _simulate_actuator(body, supply)
    details = {
        "simulation": body.model_dump(mode="json", exclude={"model"}),
        "true_parameters": used,
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
    """The supply pressure of the actuator, and the datasets it was taken from."""
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
        faults.append(
            FieldError(f"/{missing}", "is missing; the actuator has no record of its own")
        )
    if faults:
        raise InvalidRequest(faults)
    times = np.arange(body.samples or 0, dtype=np.float64) * (body.sample_time or 0.0)
    signals = InputSignals(session, store, times)
    supply = signals.sample_input("/inputs/P_a", "P_a", "Pa", body.inputs["P_a"])
    return supply, signals.parents


def _simulate_actuator(body: SimulateIn, supply: Channel) -> tuple[Recording, dict[str, float]]:
    from sysid.plants.actuator import Actuator, simulate_actuator

    given = _check_parameters(Actuator, (), body.parameters)
    if "k_a" in given and "k_b" not in given:
        given["k_b"] = given["k_a"]  # as P settles at P_a
    actuator = Actuator(**given)
    try:
        recording = simulate_actuator(actuator, supply)
    except InvalidRecord as error:
        raise InvalidRequest.from_fault("/samples", str(error)) from None
    return recording, _read_parameters(actuator)


def _simulate_tube(body: SimulateIn) -> tuple[Recording, dict[str, float]]:
    from sysid.plants.tube import Tube, add_gauge_errors, simulate_tube_record

    if body.inputs:
        raise InvalidRequest.from_fault(
            f"/inputs/{next(iter(body.inputs))}",
            "the tube is driven by its regulator; choose the parameter 'pattern', 1 or 2",
        )
    given = _check_parameters(Tube, _TUBE_OPTIONS, body.parameters)
    extra = {name: given.pop(name) for name in _TUBE_OPTIONS if name in given}
    tube = Tube(**given)
    period = body.sample_time or (0.002 if tube.length_m <= 10 else 0.01)
    stretched = 30.0 * max(1.0, tube.length_m / 40.0)
    samples = body.samples or round(stretched / period) + 1
    pattern = extra.get("pattern", 1)
    recording = simulate_tube_record(tube, pattern, samples, period)
    if "gauges" in extra:
        recording = add_gauge_errors(recording, extra["gauges"])
    return recording, {**_read_parameters(tube), "pattern": pattern}


def _check_parameters(
    kind: Any, extra: tuple[str, ...], values: dict[str, float]
) -> dict[str, Any]:
    """Parameters as the plant takes them; some are whole numbers."""
    known = [*(field.name for field in fields(kind)), *extra]
    faults = []
    for name, value in values.items():
        if name not in known:
            detail = f"the plant has no parameter {name!r}{suggest_name(name, known)}"
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
    """Noise on the output: the angle of the actuator, the far end of the tube."""
    if body.noise.sigma == 0:
        return recording
    from sysid.data.derivations import derive_recording

    output = "theta" if body.plant == "actuator" else "P2"
    return derive_recording(
        recording, [{"noise": {**body.noise.model_dump(), "channels": [output]}}]
    )
