"""Use case: a dataset simulated from a model or a plant, with inputs and noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.concurrency import simulation_limit
from service.core.errors import FieldError, InvalidRequest
from service.datasets.datasets import add_recording, describe_recording, hash_source
from service.datasets.plants import simulate_plant
from service.datasets.schemas import InputIn, SimulateIn
from service.datasets.waveforms import InputSignals
from service.models import models
from service.repositories.datasets import DatasetRepository, StoredDataset, build_dataset_row
from service.storage.objects import ObjectStore, StoredObject
from service.storage.sessions import Database
from service.storage.tables import Dataset
from sysid.core.errors import InvalidSettings, suggest_name
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording
from sysid.models.delays import check_delays
from sysid.models.model import FixedInitial, Model


@dataclass(frozen=True, slots=True)
class SimulatedDataset:
    """A recording that was simulated and is not stored, with what its dataset will say."""

    recording: Recording
    name: str
    key: str
    details: Mapping[str, Any]
    parents: tuple[str, ...]

    def to_row(self, dataset_id: str) -> Dataset:
        """The dataset as it will be, to be looked at before it is stored."""
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
        """Store it as a dataset."""
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


@simulation_limit.acquire()
def simulate_dataset(database: Database, store: ObjectStore, body: SimulateIn) -> StoredDataset:
    """Make a dataset of a model's or plant's signals; the same body gives the same dataset.

    Raises
    ------
    InvalidRequest
        With every fault: unknown model, parameter or signal, a missing value, a bad expression.
    """
    if body.plant is not None:
        return simulate_plant(database, store, body)
    found = simulate_or_find(database, store, body)
    return found if isinstance(found, StoredDataset) else found.store_dataset(database, store)


def simulate_or_find(
    database: Database, store: ObjectStore, body: SimulateIn
) -> StoredDataset | SimulatedDataset:
    """A model's signals, or the dataset that the same body made before; nothing is stored.

    Raises
    ------
    InvalidRequest
        As `simulate_dataset`.
    """
    with database.read_session() as session:
        model, document = _resolve_model(session, body.model)
        request = body.model_dump(mode="json", exclude={"name", "plant"})
        key = hash_source({**request, "model": document})
        known = DatasetRepository(session).find_by_source(key)
        if known is not None:
            return StoredDataset(known, is_new=False)
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
            signals.sample_input(f"/inputs/{one.name}", one.name, one.unit, body.inputs[one.name])
            for one in model.inputs
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
    # The compiler comes with this import, and most requests never need it.
    from sysid.simulation.simulate import simulate as outputs_of

    rest = {
        f"{state.name}(0)": 0.0
        for state, start in zip(model.states, model.initial, strict=True)
        if not isinstance(start, FixedInitial)
    }
    values = {**rest, **body.parameters}
    outputs = outputs_of(model, inputs, values, times=times).channels
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
        wrong = np.flatnonzero(~np.isfinite(channel.values))
        if wrong.size:
            raise InvalidRequest.from_fault(
                "/parameters",
                f"with these values output {channel.name!r} diverges at "
                f"t = {times[wrong[0]]:g} s; choose others, or a smaller sample_time",
            )


def check_given_delays(model: Model, values: Mapping[str, float]) -> None:
    """Refuse given values at which a lag would reach into the future.

    Raises
    ------
    InvalidRequest
        Naming the parameter.
    """
    for parameter in model.parameters:
        value = values.get(parameter.name)
        if value is None:
            continue
        # Only this one leaves its bounds: inside them the model's own lags are known to be past.
        low, high = min(value, parameter.lower), max(value, parameter.upper)
        wide = replace(parameter, lower=low, upper=high, fixed=None, tied=None, scale="linear")
        others = [wide if p is parameter else p for p in model.parameters]
        try:
            check_delays(model, others)
        except InvalidSettings as error:
            at = f"/parameters/{parameter.name}"
            detail = error.detail.removeprefix("inside these bounds ")
            raise InvalidRequest.from_fault(at, f"found {value:g}; with it {detail}") from None


def _find_parameter_faults(model: Model, values: Mapping[str, float]) -> list[FieldError]:
    # A start that the model does not fix, or another than its own, is given as `x(0)`.
    known = [*(p.name for p in model.parameters), *(f"{one.name}(0)" for one in model.states)]
    faults = [
        FieldError(
            f"/parameters/{name}", f"the model has no parameter {name!r}{suggest_name(name, known)}"
        )
        for name in values
        if name not in known
    ]
    missing = [p for p in model.parameters if p.is_free and p.name not in values]
    return faults + [
        FieldError(f"/parameters/{p.name}", f"give the true value of {p.name!r} [{p.unit}]")
        for p in missing
    ]


def _find_input_faults(model: Model, inputs: Mapping[str, InputIn]) -> list[FieldError]:
    known = [one.name for one in model.inputs]
    faults = [
        FieldError(f"/inputs/{name}", f"the model has no input {name!r}{suggest_name(name, known)}")
        for name in inputs
        if name not in known
    ]
    return faults + [
        FieldError(
            f"/inputs/{name}",
            f'give input {name!r}, such as {{"kind": "cosine", "amplitude": 1, "frequency": 0.5}}',
        )
        for name in known
        if name not in inputs
    ]
