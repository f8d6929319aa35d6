"""Use case: a dataset simulated from a model or a plant, with inputs and noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from service.core.concurrency import simulating
from service.core.errors import FieldError, InvalidRequest
from service.datasets.datasets import add_recording, described, key_of
from service.datasets.plants import simulate_plant
from service.datasets.schemas import InputIn, SimulateIn
from service.datasets.waveforms import Signals
from service.models import models
from service.repositories.datasets import DatasetRepository, Stored, row_of
from service.storage.objects import ObjectStore, StoredObject
from service.storage.sessions import Database
from service.storage.tables import Dataset
from sysid.core.errors import InvalidSettings, nearest
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording
from sysid.models.delays import check_lags
from sysid.models.model import FixedInitial, Model


@dataclass(frozen=True, slots=True)
class Simulated:
    """A recording that was simulated and is not stored, with what its dataset will say."""

    recording: Recording
    name: str
    key: str
    details: Mapping[str, Any]
    parents: tuple[str, ...]

    def row(self, dataset_id: str) -> Dataset:
        """The dataset as it will be, to be looked at before it is stored."""
        nothing = StoredObject(sha256="", size=0)
        return row_of(
            described(self.recording, name=self.name, kind="simulate", key=self.key,
                      details=self.details, content=nothing),
            dataset_id,
        )  # fmt: skip

    def keep(self, database: Database, store: ObjectStore) -> Stored:
        """Store it as a dataset."""
        return add_recording(
            database, store, self.recording, name=self.name, kind="simulate", key=self.key,
            details=self.details, parents=self.parents, relation="simulated",
        )  # fmt: skip


@simulating.one()
def simulate(database: Database, store: ObjectStore, body: SimulateIn) -> Stored:
    """Make a dataset of a model's or plant's signals; the same body gives the same dataset.

    Raises
    ------
    InvalidRequest
        With every fault: unknown model, parameter or signal, a missing value, a bad expression.
    """
    if body.plant is not None:
        return simulate_plant(database, store, body)
    found = simulated(database, store, body)
    return found if isinstance(found, Stored) else found.keep(database, store)


def simulated(database: Database, store: ObjectStore, body: SimulateIn) -> Stored | Simulated:
    """A model's signals, or the dataset that the same body made before; nothing is stored.

    Raises
    ------
    InvalidRequest
        As `simulate`.
    """
    with database.read() as session:
        model, document = _model(session, body.model)
        request = body.model_dump(mode="json", exclude={"name", "plant"})
        key = key_of({**request, "model": document})
        known = DatasetRepository(session).by_source(key)
        if known is not None:
            return Stored(known, is_new=False)
        faults = [*_parameter_faults(model, body.parameters), *_input_faults(model, body.inputs)]
        if body.samples is None or body.sample_time is None:
            missing = "samples" if body.samples is None else "sample_time"
            faults.append(FieldError(f"/{missing}", "is missing"))
        if faults:
            raise InvalidRequest(faults)
        check_lags_at(model, body.parameters)
        times = np.arange(body.samples or 0, dtype=np.float64) * (body.sample_time or 0.0)
        signals = Signals(session, store, times)
        inputs = [
            signals.on_samples(f"/inputs/{one.name}", one.name, one.unit, body.inputs[one.name])
            for one in model.inputs
        ]
    details = {
        "simulation": {**request, "name": body.name, "model": document},
        "true_parameters": body.parameters,
        "warnings": [],
    }
    return Simulated(
        _simulated(model, inputs, body, times), body.name or f"{model.name}, simulated", key,
        details, tuple(signals.parents),
    )  # fmt: skip


def _model(session: Session, reference: Any) -> tuple[Model, Any]:
    if not isinstance(reference, str | Mapping):
        raise InvalidRequest.at("/model", f"need a name or a document; found {reference!r:.60}")
    return models.resolve(session, reference)


def _simulated(
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
    check_finite(outputs, times)
    recording = Recording((*inputs, *outputs))
    if body.noise.sigma == 0:
        return recording
    from sysid.data.derivations import derive

    names = [channel.name for channel in outputs]
    return derive(recording, [{"noise": {**body.noise.model_dump(), "channels": names}}])


def check_finite(outputs: Sequence[Channel], times: FloatArray) -> None:
    """Refuse a simulation that diverges.

    Raises
    ------
    InvalidRequest
        With the output and the time.
    """
    for channel in outputs:
        wrong = np.flatnonzero(~np.isfinite(channel.values))
        if wrong.size:
            raise InvalidRequest.at(
                "/parameters",
                f"with these values output {channel.name!r} diverges at "
                f"t = {times[wrong[0]]:g} s; choose others, or a smaller sample_time",
            )


def check_lags_at(model: Model, values: Mapping[str, float]) -> None:
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
            check_lags(model, others)
        except InvalidSettings as error:
            at = f"/parameters/{parameter.name}"
            detail = error.detail.removeprefix("inside these bounds ")
            raise InvalidRequest.at(at, f"found {value:g}; with it {detail}") from None


def _parameter_faults(model: Model, values: Mapping[str, float]) -> list[FieldError]:
    # A start that the model does not fix, or another than its own, is given as `x(0)`.
    known = [*(p.name for p in model.parameters), *(f"{one.name}(0)" for one in model.states)]
    faults = [
        FieldError(f"/parameters/{name}", f"the model has no parameter {name!r}"
                   f"{nearest(name, known)}")
        for name in values if name not in known
    ]  # fmt: skip
    missing = [p for p in model.parameters if p.is_free and p.name not in values]
    return faults + [
        FieldError(f"/parameters/{p.name}", f"give the true value of {p.name!r} [{p.unit}]")
        for p in missing
    ]


def _input_faults(model: Model, inputs: Mapping[str, InputIn]) -> list[FieldError]:
    known = [one.name for one in model.inputs]
    faults = [
        FieldError(f"/inputs/{name}", f"the model has no input {name!r}{nearest(name, known)}")
        for name in inputs if name not in known
    ]  # fmt: skip
    return faults + [
        FieldError(f"/inputs/{name}", f"give input {name!r}, such as "
                   '{"kind": "cosine", "amplitude": 1, "frequency": 0.5}')
        for name in known if name not in inputs
    ]  # fmt: skip
