"""What can be known of a job before it runs: every fault is found here, and found now."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import ValidationError
from sqlalchemy.orm import Session

from service.core.errors import FieldError, faults_of
from service.core.validation import explained
from service.datasets.datasets import dataset_of
from service.jobs import warm_starts
from service.jobs.job_parameters import experiments_in, experiments_named
from service.jobs.record_checks import (
    channel_faults,
    conversion_faults,
    given_both_ways,
    length_faults,
    overridden,
    pieces_of,
    signal_faults,
    tried,
    unit_faults,
)
from service.jobs.schemas import JobIn
from service.models import models
from service.storage.tables import Dataset
from sysid.core.errors import SysidError
from sysid.models.delays import check_lags, unused
from sysid.models.model import Model, initial_parameters
from sysid.models.parameters import Parameter
from sysid.models.polynomial import check_samples
from sysid.models.ties import tied_model, ties_of

Body = dict[str, Any]
MOST_NAMED = 1000  # experiments that are believed before they are known
MOST_GENES = 10_000_000  # individuals times parameters: 80 MB for each copy of a population


class JobChecker:
    """Checks bodies of one job against what is stored; what it has read it remembers.

    `errors` of a body has every fault in it. A body without faults has, in `resolved`, its
    datasets as identifiers and an own model as its document.
    """

    def __init__(self, session: Session, unstored: Iterable[Dataset] = ()) -> None:
        """`unstored`: datasets that are known by their identifiers before they are stored."""
        self._session = session
        self._models: dict[str, tuple[Model, Any] | list[FieldError]] = {}
        self._datasets: dict[str, Dataset | str] = {one.id: one for one in unstored}

    def errors(self, body: Body) -> list[FieldError]:
        """Every fault of a body in its normal form."""
        found = [*conversion_faults(body), *self._missing_datasets(body)]
        known = self.model(body["model"])
        if isinstance(known, list):
            return found + known
        model = known[0]
        parameters = overridden(found, self._all_parameters(body, model), body["parameters"])
        own = parameters[: len(model.parameters)]
        tied = tied_model(model, tried(ties_of, found, model, parameters) or {})
        tried(check_lags, found, tied, own)
        found += _freedom_faults(parameters, body["algorithm"]["population"])
        found += self._too_few_for_terms(body, model)
        found += _unused_faults(tied, own, body["weights"])
        found += self._repeated(body)
        found += self._channels(body, model)
        found += self._lengths(body, tied, own)
        found += self._too_few_samples(body, model, parameters)
        found += self._units(body, model)
        found += warm_starts.faults(self._session, body["warm_start"], model)
        return found + list(signal_faults(body, model))

    def resolved(self, body: Body) -> Body:
        """The body with identifiers of datasets, and an own model as its document."""
        model = self.model(body["model"])
        assert not isinstance(model, list)
        body = {**body, "model": model[1], "datasets": self.identifiers(body["datasets"])}
        body["warm_start"] = self.warm_start(body["warm_start"])
        if body["trend"] is not None:
            reference = self.warm_start(body["trend"]["reference"])
            body["trend"] = {**body["trend"], "reference": reference}
        kept = body["validation"]
        if kept is not None and kept["datasets"] is not None:
            body["validation"] = {**kept, "datasets": self.identifiers(kept["datasets"])}
        return body

    def warm_start(self, reference: str | None) -> str | None:
        """The run that is meant now: what is accepted later does not change a job that waits."""
        return warm_starts.resolved(self._session, reference)

    def model(self, reference: Any) -> tuple[Model, Any] | list[FieldError]:
        """The model and what to store for it, or what is wrong with it."""
        key = repr(reference)
        if key not in self._models:
            try:
                self._models[key] = models.resolve(self._session, reference)
            except SysidError as error:
                self._models[key] = [fault_in_job(reference, fault) for fault in faults_of(error)]
        return self._models[key]

    def identifiers(self, references: list[str]) -> list[str]:
        """Identifiers of datasets that are known to be there."""
        found = (self.dataset(reference) for reference in references)
        return [one.id for one in found if isinstance(one, Dataset)]

    def dataset(self, reference: str) -> Dataset | str:
        """The dataset of that identifier or name, or why there is none."""
        if reference not in self._datasets:
            self._datasets[reference] = dataset_of(self._session, reference)
        return self._datasets[reference]

    def _all_parameters(self, body: Body, model: Model) -> tuple[Parameter, ...]:
        """The model's parameters, and the initial states to be estimated in each experiment.

        Of datasets that are missing, as many experiments as are named.
        """
        found = [self.dataset(reference) for reference in body["datasets"]]
        pieces = sum(experiments_in(one) for one in found if isinstance(one, Dataset))
        if not all(isinstance(one, Dataset) for one in found):
            pieces = max(pieces, min(experiments_named(body["parameters"]), MOST_NAMED))
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

    def _units(self, body: Body, model: Model) -> Iterator[FieldError]:
        return unit_faults(model, body["channels"], self._there(body))

    def _channels(self, body: Body, model: Model) -> Iterator[FieldError]:
        yield from given_both_ways(body["channels"], model)
        for _, dataset in self._there(body):
            yield from channel_faults(body["channels"], model, dataset)

    def _lengths(
        self, body: Body, model: Model, parameters: tuple[Parameter, ...]
    ) -> Iterator[FieldError]:
        kept: float | None = (body["validation"] or {}).get("fraction")
        for pointer, dataset in self._there(body):
            for piece in pieces_of(dataset):
                estimated = piece if kept is None else piece.without(kept)
                if estimated is not None:
                    yield from length_faults(pointer, model, parameters, estimated, body["skip"])
                else:
                    yield FieldError(
                        "/validation/fraction",
                        f"found {kept!r}: one part of a record of {piece.samples} samples would "
                        "be empty",
                    )

    def _too_few_for_terms(self, body: Body, model: Model) -> list[FieldError]:
        found: list[FieldError] = []
        if model.rule is not None:
            tried(check_samples, found, len(model.terms), self._samples(body))
        return found

    def _too_few_samples(
        self, body: Body, model: Model, parameters: tuple[Parameter, ...]
    ) -> Iterator[FieldError]:
        if model.rule is None:  # of candidates not all are kept; `check_samples` looks at them
            yield from _sample_faults(parameters, self._scored(body, model))

    def _there(self, body: Body) -> list[tuple[str, Dataset]]:
        """The datasets of a body that there are, with their places."""
        found = ((pointer, self.dataset(reference)) for pointer, reference in _references(body))
        return [(pointer, one) for pointer, one in found if isinstance(one, Dataset)]


def value_faults(pointer: str, body: Body) -> list[FieldError]:
    """What the wire type says against a body into which a sweep put a value."""
    try:
        JobIn.model_validate(body)
    except ValidationError as error:
        faults = explained(error.errors(), body, JobIn)
        return [FieldError(pointer, str(one)) for one in faults]
    return []


def _unused_faults(
    model: Model, parameters: tuple[Parameter, ...], weights: Mapping[str, float] | None
) -> list[FieldError]:
    """Parameters that no output depends on, and the like."""
    return [FieldError(one.pointer, one.detail) for one in unused(model, parameters, weights)]


def _references(body: Body) -> Iterator[tuple[str, str]]:
    for index, reference in enumerate(body["datasets"]):
        yield f"/datasets/{index}", reference
    for index, reference in enumerate((body["validation"] or {}).get("datasets") or []):
        yield f"/validation/datasets/{index}", reference


def _sample_faults(parameters: tuple[Parameter, ...], samples: int) -> Iterator[FieldError]:
    free = sum(one.is_free for one in parameters)
    if 0 < samples < free:
        yield FieldError(
            "/datasets",
            f"the records have {samples} scored samples in all for {free} free parameters; need "
            "at least as many samples, or fix some of the parameters",
        )


def _freedom_faults(parameters: tuple[Parameter, ...], population: int) -> Iterator[FieldError]:
    free = [one for one in parameters if one.is_free]
    if not free:
        yield FieldError("/parameters", "every parameter is fixed; leave one free")
    if population * len(free) > MOST_GENES:
        yield FieldError(
            "/algorithm/population",
            f"found {population} individuals of {len(free)} free parameters; need at most "
            f"{MOST_GENES // len(free)}, so that the population fits into memory",
        )


def fault_in_job(reference: Any, fault: FieldError) -> FieldError:
    """A fault of a model at its place in the job that names the model or holds it."""
    if isinstance(reference, Mapping):
        return FieldError("/model" + fault.pointer, fault.detail, fault.column)
    return fault
