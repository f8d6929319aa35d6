"""What can be known of a job before it runs: every fault is found here, and found now."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

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
from sysid.models.initial import initial_parameters
from sysid.models.lags import check_lags
from sysid.models.model import Model
from sysid.models.polynomial import check_samples
from sysid.parameters import Parameter, override
from sysid.ties import tied_model, ties_of

Body = dict[str, Any]
MOST_GENES = 10_000_000  # individuals times parameters: 80 MB for each copy of a population


@dataclass(frozen=True, slots=True)
class _Piece:
    """What is known of the length of one record; `words` say which part of it is meant."""

    duration: float
    samples: int
    period: float | None
    words: str = ""

    def without(self, fraction: float) -> "_Piece | None":
        """The part for estimation; None if it, or the part for validation, has no sample."""
        left = self.samples - round(fraction * self.samples)
        if not 0 < left < self.samples:
            return None
        # Where an irregular record is cut is not known here: its whole length is asked for.
        duration = self.duration if self.period is None else (left - 1) * self.period
        return _Piece(duration, left, self.period, "of the part for estimation: ")


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
        found += _freedom_faults(parameters, body["algorithm"]["population"])
        own = (parameters or model[0].parameters)[: len(model[0].parameters)]
        ties = _tried(ties_of, found, model[0], parameters or model[0].parameters)
        tied = tied_model(model[0], ties or {})
        _tried(check_lags, found, tied, own)
        if model[0].rule is not None:
            _tried(check_samples, found, len(model[0].terms), self._samples(body))
        found += self._repeated(body)
        found += self._data(body, tied, own)
        if model[0].rule is None:  # of candidates not all are kept; `check_samples` looks at them
            found += _sample_faults(parameters, self._scored(body, model[0]))
        found += self._unit_faults(body, model[0])
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
        found = [self.dataset(reference) for reference in body["datasets"]]
        pieces = sum(
            max(1, len(one.details.get("segments") or ())) for one in found
            if isinstance(one, Dataset)
        )  # fmt: skip
        return (*model.parameters, *initial_parameters(model, pieces))

    def _samples(self, body: Body) -> int:
        """Samples of all datasets for the estimate together; a dataset that is missing has many."""
        found = [self.dataset(reference) for reference in body["datasets"]]
        if not all(isinstance(one, Dataset) for one in found):
            return MOST_GENES
        return sum(one.n_samples for one in found if isinstance(one, Dataset))

    def _scored(self, body: Body, model: Model) -> int:
        """Samples of all outputs that are fitted, if none is missing."""
        kept: float = (body["validation"] or {}).get("fraction") or 0.0
        samples = self._samples(body)
        skipped = body["skip"] * len(body["datasets"])
        return int(samples - round(kept * samples) - skipped) * len(model.outputs)

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

    def _repeated(self, body: Body) -> Iterator[FieldError]:
        """Datasets that are named twice, or kept for validation though they are fitted."""
        places: dict[str, tuple[str, str]] = {}
        for pointer, reference in _references(body):
            dataset = self.dataset(reference)
            if isinstance(dataset, str):
                continue
            first, name = places.setdefault(dataset.sha256, (pointer, reference))
            if first != pointer:
                yield FieldError(
                    pointer, f"{reference!r} is the same recording as {name!r} at {first}; "
                    "name another, or leave it out",
                )  # fmt: skip

    def _unit_faults(self, body: Body, model: Model) -> Iterator[FieldError]:
        """Validation data that are in other units than the data that are fitted."""
        kept = (body["validation"] or {}).get("datasets") or []
        first = self.dataset(body["datasets"][0])
        if isinstance(first, str):
            return
        known = {channel["name"]: channel.get("unit") for channel in first.channels}
        inputs, outputs = signals_of(model)
        for index, reference in enumerate(kept):
            dataset = self.dataset(reference)
            for channel in [] if isinstance(dataset, str) else dataset.channels:
                name, unit = channel["name"], channel.get("unit")
                used = name in {body["channels"].get(s, s) for s in (*inputs, *outputs)}
                if used and _differ(unit, known.get(name)):
                    yield FieldError(
                        f"/validation/datasets/{index}",
                        f"channel {name!r} is in {unit}, but in {first.name} it is in "
                        f"{known[name]}; convert one of them",
                    )

    def _data(
        self, body: Body, model: Model, parameters: tuple[Parameter, ...]
    ) -> Iterator[FieldError]:
        kept: float | None = (body["validation"] or {}).get("fraction")
        for pointer, reference in _references(body):
            dataset = self.dataset(reference)
            if isinstance(dataset, str):
                yield FieldError(pointer, dataset)
                continue
            yield from _channel_faults(body["channels"], model, dataset)
            for piece in _pieces(dataset):
                estimated = piece if kept is None else piece.without(kept)
                if estimated is not None:
                    yield from _length_faults(pointer, model, parameters, estimated, body["skip"])
                else:
                    yield FieldError(
                        "/validation/fraction",
                        f"found {kept!r}: one part of a record of {piece.samples} samples would "
                        "be empty",
                    )


def value_faults(pointer: str, body: Body) -> list[FieldError]:
    """What the wire type says against a body into which a sweep put a value."""
    try:
        JobIn.model_validate(body)
    except ValidationError as error:
        faults = explained(error.errors(), body, JobIn)
        return [FieldError(pointer, str(one)) for one in faults]
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
    for name in body["hold"]:
        if name not in inputs:
            hint = nearest(name, inputs)
            yield FieldError(f"/hold/{name}", f"model {model.name!r} has no input {name!r}{hint}")
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


def _pieces(dataset: Dataset) -> list[_Piece]:
    """The records that a dataset gives: its segments, or all of it."""
    period = dataset.sample_time
    spans = [one["stop"] - one["start"] for one in dataset.details.get("segments") or []]
    if not spans:
        return [_Piece(dataset.duration, dataset.n_samples, period)]
    if period is None:  # how many samples each has is not stored; all together are enough to ask
        return [_Piece(min(spans), dataset.n_samples, None)]
    return [_Piece(span, round(span / period) + 1, period) for span in sorted(set(spans))]


def _length_faults(
    pointer: str, model: Model, parameters: tuple[Parameter, ...], piece: _Piece, skip: int
) -> Iterator[FieldError]:
    period = model.solver.step or piece.period or piece.duration / max(piece.samples - 1, 1)
    substeps = model.solver.substeps
    needed, signal = longest_delay(model, parameters, period / substeps)
    what = f"the largest lag of {signal!r}" if needed else "a simulation"
    if piece.duration <= needed:
        error = RecordTooShort(piece.duration, needed, what)
        yield FieldError(pointer, f"{piece.words}{error}")
    if (piece.samples - 1 - skip) * substeps < model.memory:
        yield FieldError(
            pointer,
            f"{piece.words}the record has {piece.samples} samples; the model's memory "
            f"({model.memory}) and 'skip' ({skip}) need more",
        )


def _differ(unit: str | None, other: str | None) -> bool:
    """Whether two units are known and not the same; 1 is that of a channel without one."""
    return unit not in (None, "", "1") and other not in (None, "", "1") and unit != other


def _sample_faults(parameters: tuple[Parameter, ...] | None, samples: int) -> Iterator[FieldError]:
    free = sum(one.is_free for one in parameters or ())
    if 0 < samples < free:
        yield FieldError(
            "/datasets",
            f"the records have {samples} scored samples in all for {free} free parameters; need "
            "at least as many samples, or fix some of the parameters",
        )


def _freedom_faults(
    parameters: tuple[Parameter, ...] | None, population: int
) -> Iterator[FieldError]:
    free = [one for one in parameters or () if one.is_free]
    if parameters is not None and not free:
        yield FieldError("/parameters", "every parameter is fixed; leave one free")
    if population * len(free) > MOST_GENES:
        yield FieldError(
            "/algorithm/population",
            f"found {population} individuals of {len(free)} free parameters; need at most "
            f"{MOST_GENES // len(free)}, so that the population fits into memory",
        )


def _tried(make: Any, errors: list[FieldError], *arguments: Any) -> Any:
    try:
        return make(*arguments)
    except SysidError as error:
        errors += faults_of(error)
        return None
