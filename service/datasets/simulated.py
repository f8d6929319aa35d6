"""Use case: a dataset simulated from a model or a plant, with inputs and noise."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest
from service.core.process.concurrency import FairPlaces, simulation_places
from service.datasets.dataset_schemas import InputIn, SimulateIn
from service.datasets.datasets import (
    add_recording,
    describe_recording,
    find_existing,
    hash_source,
)
from service.datasets.plants import simulate_plant
from service.datasets.waveforms import InputSignals
from service.models import models
from service.queue.daily_limit import check_budget, count_evaluations
from service.repositories.dataset_rows import StoredDataset, build_dataset_row
from service.storage.objects import ObjectStore, StoredObject
from service.storage.sessions import Database
from service.storage.tables import Dataset
from sysid.core.errors import InvalidSettings, suggest_name
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording
from sysid.models.model import DerivedInitial, FixedInitial, Model
from sysid.models.model_delays import check_delays

LARGE_SAMPLES = 1_000_000
_large_places = FairPlaces(1, 1, what="simulations of more than a million samples")
"""One of these at a time: a sample takes some 370 bytes meanwhile (10⁷ of two channels)."""


@dataclass(frozen=True, slots=True)
class SimulatedDataset:
    """A simulated recording that is not stored yet, with the description of its dataset."""

    recording: Recording
    name: str
    key: str
    details: Mapping[str, Any]
    parents: tuple[str, ...]

    def to_row(self, dataset_id: str) -> Dataset:
        """Build the row of the dataset, to preview it before it is stored."""
        nothing = StoredObject(sha256="", size=0)
        return build_dataset_row(
            describe_recording(
                self.recording,
                name=self.name,
                kind="simulate",
                key=self.key,
                details=self.details,
                content=nothing,
            ),
            dataset_id,
        )

    def store_dataset(self, database: Database, store: ObjectStore) -> StoredDataset:
        """Store the recording as a dataset."""
        return add_recording(
            database,
            store,
            self.recording,
            name=self.name,
            kind="simulate",
            key=self.key,
            details=self.details,
            parents=self.parents,
            relation="simulated",
        )


def simulate_dataset(database: Database, store: ObjectStore, body: SimulateIn) -> StoredDataset:
    """Simulate a model or a plant as a dataset; the same body returns the same dataset.

    Raises
    ------
    InvalidRequest
        With every fault: unknown model, parameter or signal, a missing value, a bad expression.
    """
    check_budget(database)
    project = database.owner.project_id
    with ExitStack() as places:
        if (body.samples or 0) > LARGE_SAMPLES:
            places.enter_context(_large_places.hold(project))
        places.enter_context(simulation_places.hold(project))
        if body.plant is not None:
            made = simulate_plant(database, store, body)
            count_evaluations(database, 1)
            return made
        dataset = simulate_or_find(database, store, body)
        if isinstance(dataset, StoredDataset):
            return dataset
        count_evaluations(database, 1)
        return dataset.store_dataset(database, store)


def simulate_or_find(
    database: Database, store: ObjectStore, body: SimulateIn
) -> StoredDataset | SimulatedDataset:
    """Simulate a model, or return the existing dataset of the same body; store nothing.

    Raises
    ------
    InvalidRequest
        As `simulate_dataset`.
    """
    with database.read_session() as session:
        model, document = _resolve_model(session, body.model)
        request = body.model_dump(mode="json", exclude={"name", "plant"})
        key = hash_source({**request, "model": document})
        existing = find_existing(session, store, key)
        if existing is not None:
            return StoredDataset(existing, is_new=False)
        faults = [
            *_find_parameter_faults(model, body.parameters),
            *_find_input_faults(model, body.inputs),
        ]
        if body.samples is None or body.sample_time is None:
            missing = "samples" if body.samples is None else "sample_time"
            faults.append(FieldError(f"/{missing}", "is missing"))
        if faults:
            raise InvalidRequest(faults)
        check_given_delays(model, body.parameters)
        times = np.arange(body.samples or 0, dtype=np.float64) * (body.sample_time or 0.0)
        signals = InputSignals(session, store, times)
        inputs = [
            signals.sample_input(
                f"/inputs/{quantity.name}", quantity.name, quantity.unit, body.inputs[quantity.name]
            )
            for quantity in model.inputs
        ]
    details = {
        "simulation": {**request, "name": body.name, "model": document},
        "true_parameters": body.parameters,
        "warnings": [],
    }
    return SimulatedDataset(
        _simulate_recording(model, inputs, body, times),
        body.name or f"{model.name}, simulated",
        key,
        details,
        tuple(signals.parents),
    )


def _resolve_model(session: Session, reference: Any) -> tuple[Model, Any]:
    if not isinstance(reference, str | Mapping):
        raise InvalidRequest.from_fault(
            "/model", f"need a name or a document; found {reference!r:.60}"
        )
    return models.resolve_model(session, reference)


def _simulate_recording(
    model: Model, inputs: list[Channel], body: SimulateIn, times: FloatArray
) -> Recording:
    # This import loads the compiler, which most requests never need.
    from sysid.simulation.simulate import simulate as simulate_model

    initial_values = {
        f"{state.name}(0)": 0.0
        for state, start in zip(model.states, model.initial, strict=True)
        if not isinstance(start, FixedInitial | DerivedInitial)
    }
    values = {**initial_values, **body.parameters}
    outputs = simulate_model(model, inputs, values, times=times).channels
    check_finite_outputs(outputs, times)
    recording = Recording((*inputs, *outputs))
    if body.noise.sigma == 0:
        return recording
    from sysid.data.derivations import derive_recording

    names = [channel.name for channel in outputs]
    return derive_recording(recording, [{"noise": {**body.noise.model_dump(), "channels": names}}])


def check_finite_outputs(outputs: Sequence[Channel], times: FloatArray) -> None:
    """Refuse a simulation that diverges.

    Raises
    ------
    InvalidRequest
        With the output and the time.
    """
    for channel in outputs:
        invalid = np.flatnonzero(~np.isfinite(channel.values))
        if invalid.size:
            raise InvalidRequest.from_fault(
                "/parameters",
                f"with these values output {channel.name!r} diverges at "
                f"t = {times[invalid[0]]:g} s; choose other values, or a shorter sampling period",
            )


def check_given_delays(model: Model, values: Mapping[str, float]) -> None:
    """Refuse values at which a delay would be negative and read the future.

    Raises
    ------
    InvalidRequest
        With the name of the parameter.
    """
    for parameter in model.parameters:
        value = values.get(parameter.name)
        if value is None:
            continue
        # Only this parameter leaves its bounds. Inside them all delays of the model are valid.
        low, high = min(value, parameter.lower), max(value, parameter.upper)
        wide = replace(parameter, lower=low, upper=high, fixed=None, tied=None, scale="linear")
        others = [wide if p is parameter else p for p in model.parameters]
        try:
            check_delays(model, others)
        except InvalidSettings as error:
            pointer = f"/parameters/{parameter.name}"
            detail = error.detail.removeprefix("inside these bounds ")
            raise InvalidRequest.from_fault(pointer, f"found {value:g}; with it {detail}") from None


def _find_parameter_faults(model: Model, values: Mapping[str, float]) -> list[FieldError]:
    # `x(0)` sets or replaces the initial value of a state.
    valid_names = [
        *(p.name for p in model.parameters),
        *(f"{state.name}(0)" for state in model.states),
    ]
    faults = [
        FieldError(
            f"/parameters/{name}",
            f"the model has no parameter {name!r}{suggest_name(name, valid_names)}",
        )
        for name in values
        if name not in valid_names
    ]
    missing = [p for p in model.parameters if p.is_free and p.name not in values]
    return faults + [
        FieldError(f"/parameters/{p.name}", f"give the true value of {p.name!r} [{p.unit}]")
        for p in missing
    ]


def _find_input_faults(model: Model, inputs: Mapping[str, InputIn]) -> list[FieldError]:
    valid_names = [quantity.name for quantity in model.inputs]
    faults = [
        FieldError(
            f"/inputs/{name}", f"the model has no input {name!r}{suggest_name(name, valid_names)}"
        )
        for name in inputs
        if name not in valid_names
    ]
    return faults + [
        FieldError(
            f"/inputs/{name}",
            f'give input {name!r}, such as {{"kind": "cosine", "amplitude": 1, "frequency": 0.5}}',
        )
        for name in valid_names
        if name not in inputs
    ]
