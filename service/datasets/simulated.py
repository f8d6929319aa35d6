"""Use case: a dataset simulated from a model or a plant, with inputs and noise."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.errors import FieldError, InvalidRequest
from service.core.process.concurrency import ReaderPlaces
from service.datasets.dataset_schemas import InputIn, SimulateIn
from service.datasets.datasets import (
    add_recording,
    describe_recording,
    find_existing,
    hash_source,
)
from service.datasets.large_simulation import check_finite_outputs, simulate_outputs
from service.datasets.plants import simulate_plant
from service.datasets.waveforms import InputSignals
from service.models import models
from service.queue.daily_limit import compute_on_request
from service.repositories.dataset_rows import StoredDataset, build_dataset_row
from service.storage.objects import ObjectStore, StoredObject
from service.storage.sessions import Database
from service.storage.tables import Dataset
from sysid.core.errors import InvalidSettings, suggest_name
from sysid.data.records import Recording
from sysid.models.model import DerivedInitial, FixedInitial, Model
from sysid.models.model_delays import check_delays


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


def simulate_dataset(
    database: Database, store: ObjectStore, readers: ReaderPlaces, body: SimulateIn
) -> StoredDataset:
    """Simulate a model or a plant as a dataset; the same body returns the same dataset.

    Raises
    ------
    InvalidRequest
        With every fault: unknown model, parameter or signal, a missing value, a bad expression.
    """
    if body.plant is not None:
        with compute_on_request(database):
            return simulate_plant(database, store, body)
    dataset = simulate_or_find(database, store, readers, body)
    if isinstance(dataset, StoredDataset):
        return dataset
    return dataset.store_dataset(database, store)


def simulate_or_find(
    database: Database, store: ObjectStore, readers: ReaderPlaces, body: SimulateIn
) -> StoredDataset | SimulatedDataset:
    """Simulate a model, or return the existing dataset of the same body; store nothing.

    Raises
    ------
    InvalidRequest
        As `simulate_dataset`.
    """
    with compute_on_request(database) as computation:
        dataset = _simulate_or_find(database, store, readers, body)
        if isinstance(dataset, StoredDataset):
            computation.evaluations = 0
        return dataset


def _simulate_or_find(
    database: Database, store: ObjectStore, readers: ReaderPlaces, body: SimulateIn
) -> StoredDataset | SimulatedDataset:
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
    outputs = simulate_outputs(
        model,
        inputs,
        _complete_values(model, body),
        times,
        readers,
        database.owner.project_id,
    ).channels
    check_finite_outputs(outputs, times)
    return SimulatedDataset(
        _add_noise(Recording((*inputs, *outputs)), body, [channel.name for channel in outputs]),
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


def _complete_values(model: Model, body: SimulateIn) -> dict[str, float]:
    """Complete the given values by zero for the states without an initial value."""
    initial_values = {
        f"{state.name}(0)": 0.0
        for state, start in zip(model.states, model.initial, strict=True)
        if not isinstance(start, FixedInitial | DerivedInitial)
    }
    return {**initial_values, **body.parameters}


def _add_noise(recording: Recording, body: SimulateIn, outputs: list[str]) -> Recording:
    if body.noise.sigma == 0:
        return recording
    from sysid.data.derivations import derive_recording

    return derive_recording(
        recording, [{"noise": {**body.noise.model_dump(), "channels": outputs}}]
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
