"""What can be known of a job before it runs: every fault is found here, and found now."""

from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

from pydantic import ValidationError
from sqlalchemy.orm import Session

from service import models
from service.conversion import algorithm_of, faults_of, loss_of
from service.errors import FieldError
from service.pointers import explained
from service.schemas_jobs import JobIn
from service.storage.datasets import DatasetRepository
from service.storage.errors import NotFound
from service.storage.lookups import dataset_names, datasets_named
from service.storage.tables import Dataset
from sysid.errors import RecordTooShort, SysidError, nearest
from sysid.language.intervals import bounds
from sysid.language.lags import past_values
from sysid.models.lags import check_lags
from sysid.models.model import EstimatedInitial, Model
from sysid.parameters import Parameter, override

Body = dict[str, Any]
T = TypeVar("T")


class JobChecker:
    """Checks bodies of one job against what is stored; what it has read it remembers.

    `errors` of a body has every fault in it. A body without faults has, in `resolved`, its
    datasets as identifiers and an own model as its document.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._models: dict[str, tuple[Model, Any] | list[FieldError]] = {}
        self._datasets: dict[str, Dataset | str] = {}

    def errors(self, body: Body) -> list[FieldError]:
        """Every fault of a body in its normal form."""
        found = list(self._conversions(body))
        model = self.model(body["model"])
        if isinstance(model, list):
            return found + model + list(self._missing_datasets(body))
        parameters = _tried(
            override, found, self._all_parameters(body, model[0]), body["parameters"]
        )
        own = (parameters or model[0].parameters)[: len(model[0].parameters)]
        _tried(check_lags, found, model[0], own)
        found += self._data(body, model[0], own)
        return found + list(_signal_faults(body, model[0]))

    def resolved(self, body: Body) -> Body:
        """The body with identifiers of datasets, and an own model as its document."""
        model = self.model(body["model"])
        assert not isinstance(model, list)
        body = {**body, "model": model[1], "datasets": self.identifiers(body["datasets"])}
        kept = body["validation"]
        if kept is not None and kept["datasets"] is not None:
            body["validation"] = {**kept, "datasets": self.identifiers(kept["datasets"])}
        return body

    def model(self, reference: Any) -> tuple[Model, Any] | list[FieldError]:
        """The model and what to store for it, or what is wrong with it."""
        key = repr(reference)
        if key not in self._models:
            try:
                self._models[key] = models.resolve(self._session, reference)
            except SysidError as error:
                inside = "/model" if isinstance(reference, Mapping) else ""
                self._models[key] = [
                    FieldError(inside + fault.pointer, fault.detail, fault.column)
                    for fault in faults_of(error)
                ]
        return self._models[key]

    def identifiers(self, references: list[str]) -> list[str]:
        """Identifiers of datasets that are known to be there."""
        found = (self.dataset(reference) for reference in references)
        return [one.id for one in found if isinstance(one, Dataset)]

    def dataset(self, reference: str) -> Dataset | str:
        """The dataset of that identifier or name, or why there is none."""
        if reference not in self._datasets:
            self._datasets[reference] = self._find(reference)
        return self._datasets[reference]

    def _find(self, reference: str) -> Dataset | str:
        try:
            return DatasetRepository(self._session).get(reference)
        except NotFound:
            named = datasets_named(self._session, reference)
        if len(named) == 1:
            return named[0]
        if named:
            ids = ", ".join(one.id for one in named)
            return f"{len(named)} datasets are named {reference!r}; give one of the ids {ids}"
        hint = nearest(reference, set(dataset_names(self._session)))
        if "/" in reference or reference.endswith((".csv", ".mcap")):
            hint = "; a path of a file is not read here, add the file first: `lagid dataset add`"
        return f"there is no dataset {reference!r}{hint}"

    def _all_parameters(self, body: Body, model: Model) -> tuple[Parameter, ...]:
        """The model's parameters, and the initial states to be estimated in each experiment."""
        if not any(isinstance(start, EstimatedInitial) for start in model.initial):
            return model.parameters
        # Only such models pay for this import, which brings all of SciPy's signal processing.
        from sysid.experiments import initial_parameters

        found = [self.dataset(reference) for reference in body["datasets"]]
        pieces = sum(
            max(1, len(one.details.get("segments") or ())) for one in found
            if isinstance(one, Dataset)
        )  # fmt: skip
        return (*model.parameters, *initial_parameters(model, pieces))

    def _conversions(self, body: Body) -> Iterator[FieldError]:
        found: list[FieldError] = []
        _tried(algorithm_of, found, body["algorithm"])
        _tried(loss_of, found, body["loss"])
        yield from found

    def _missing_datasets(self, body: Body) -> Iterator[FieldError]:
        for pointer, reference in _references(body):
            dataset = self.dataset(reference)
            if isinstance(dataset, str):
                yield FieldError(pointer, dataset)

    def _data(
        self, body: Body, model: Model, parameters: tuple[Parameter, ...]
    ) -> Iterator[FieldError]:
        for pointer, reference in _references(body):
            dataset = self.dataset(reference)
            if isinstance(dataset, str):
                yield FieldError(pointer, dataset)
                continue
            yield from _channel_faults(body["channels"], model, dataset)
            yield from _length_faults(pointer, model, parameters, dataset, body["skip"])


def value_faults(pointer: str, body: Body) -> list[FieldError]:
    """What the wire type says against a body into which a sweep put a value."""
    try:
        JobIn.model_validate(body)
    except ValidationError as error:
        faults = explained(error.errors(), body, JobIn)
        return [FieldError(pointer, f"{one.pointer}: {one.detail}") for one in faults]
    return []


def signals_of(model: Model) -> tuple[list[str], list[str]]:
    """Names of a model's inputs and outputs: the signals that channels are given to."""
    return [one.name for one in model.inputs], [one.name for one in model.outputs]


def longest_delay(
    model: Model, parameters: tuple[Parameter, ...], period: float | None
) -> tuple[float, str]:
    """The longest time (s) that any equation may look back, and which signal it looks at."""
    between = {p.name: (p.lower, p.upper) if p.is_free else (p.fixed or 0.0,) * 2
               for p in parameters}  # fmt: skip
    longest = (0.0, "")
    trees = (*model.equations, *(output.expression for output in model.outputs))
    for past in (one for tree in trees for one in past_values(tree)):
        back = float(past.offset)
        if past.lag is not None:
            back += bounds(past.lag, between, period)[1]
        if model.form != "differential":
            back *= period or 0.0
        longest = max(longest, (back, past.name))
    return longest


def _references(body: Body) -> Iterator[tuple[str, str]]:
    for index, reference in enumerate(body["datasets"]):
        yield f"/datasets/{index}", reference
    for index, reference in enumerate((body["validation"] or {}).get("datasets") or []):
        yield f"/validation/datasets/{index}", reference


def _signal_faults(body: Body, model: Model) -> Iterator[FieldError]:
    inputs, outputs = signals_of(model)
    for name in body["channels"]:
        if name not in (*inputs, *outputs):
            hint = nearest(name, (*inputs, *outputs))
            yield FieldError(
                f"/channels/{name}", f"model {model.name!r} has no signal {name!r}{hint}"
            )
    for name, weight in (body["weights"] or {}).items():
        if name not in outputs:
            hint = nearest(name, outputs)
            yield FieldError(f"/weights/{name}", f"the model has no output {name!r}{hint}")
        elif not weight > 0:
            yield FieldError(f"/weights/{name}", f"found {weight:g}; need a positive number")


def _channel_faults(
    channels: Mapping[str, str], model: Model, dataset: Dataset
) -> Iterator[FieldError]:
    known = [channel["name"] for channel in dataset.channels]
    inputs, outputs = signals_of(model)
    for signal in (*inputs, *outputs):
        channel = channels.get(signal, signal)
        if channel not in known:
            yield FieldError(
                f"/channels/{signal}" if signal in channels else "/channels",
                f"dataset {dataset.id} ({dataset.name}) has no channel {channel!r} for signal "
                f"{signal!r} of the model{nearest(channel, known)}",
            )


def _length_faults(
    pointer: str, model: Model, parameters: tuple[Parameter, ...], dataset: Dataset, skip: int
) -> Iterator[FieldError]:
    pieces = dataset.details.get("segments") or []
    duration = min([piece["stop"] - piece["start"] for piece in pieces] or [dataset.duration])
    samples = dataset.n_samples
    period = model.solver.step or dataset.sample_time or duration / max(samples - 1, 1)
    needed, signal = longest_delay(model, parameters, period)
    if duration <= needed:
        error = RecordTooShort(duration, needed, f"the largest lag of {signal!r}")
        yield FieldError(pointer, str(error))
    if samples <= model.memory + skip:
        yield FieldError(
            pointer,
            f"the record has {samples} samples; the model's memory ({model.memory}) and 'skip' "
            f"({skip}) need more",
        )


def _tried(make: Any, errors: list[FieldError], *arguments: Any) -> Any:
    try:
        return make(*arguments)
    except SysidError as error:
        errors += faults_of(error)
        return None
