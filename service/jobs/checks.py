"""Checks of a job before it runs. Every fault that can be detected is reported at once."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from pydantic import ValidationError
from sqlalchemy.orm import Session

from service.core.bodies.validation import explain_errors
from service.core.errors import FieldError, to_field_errors
from service.datasets.datasets import resolve_dataset
from service.jobs import warm_starts
from service.jobs.job_parameters import count_dataset_experiments, count_named_experiments
from service.jobs.job_schemas import JobIn
from service.jobs.record_checks import (
    collect_faults,
    find_channel_faults,
    find_channels_given_twice,
    find_length_faults,
    find_setting_conflicts,
    find_signal_faults,
    find_unit_faults,
    find_weight_count_faults,
    list_record_lengths,
    override_by_request,
)
from service.jobs.to_core import read_noise
from service.models import models
from service.storage.tables import Dataset
from sysid.core.errors import SysidError
from sysid.core.settings import Weights
from sysid.models.model import Model, build_initial_parameters
from sysid.models.model_delays import check_delays, find_unused_settings
from sysid.models.parameters import Parameter
from sysid.models.polynomial import check_candidate_count
from sysid.models.starts import replace_starts
from sysid.models.ties import apply_ties, resolve_ties

JobBody = dict[str, Any]
MAX_NAMED_EXPERIMENTS = 1000  # experiments assumed while datasets are missing
MAX_GENES = 10_000_000  # individuals × parameters: 80 MB for each copy of a population


class JobChecker:
    """Checks the bodies of one job against stored data; it caches what it has read.

    `find_faults` reports every fault of a body. `resolve_body` replaces names of datasets by
    identifiers, and the model of a valid body by its document.
    """

    def __init__(self, session: Session, unstored: Iterable[Dataset] = ()) -> None:
        """`unstored` are datasets that already have identifiers but are not stored yet."""
        self._session = session
        self._models: dict[str, tuple[Model, Any] | list[FieldError]] = {}
        self._datasets: dict[str, Dataset | str] = {dataset.id: dataset for dataset in unstored}

    def find_faults(self, body: JobBody) -> list[FieldError]:
        """List every fault of a body in its normal form."""
        faults = [*find_setting_conflicts(body), *self._find_missing_datasets(body)]
        resolved = self.resolve_model(body["model"])
        if isinstance(resolved, list):
            return faults + resolved
        model = collect_faults(replace_starts, faults, resolved[0], body["initial"]) or resolved[0]
        declared = self._list_parameters(body, model)
        parameters = override_by_request(faults, model, declared, body)
        model_parameters = parameters[: len(model.parameters)]
        tied = apply_ties(model, collect_faults(resolve_ties, faults, model, parameters) or {})
        collect_faults(check_delays, faults, tied, model_parameters)
        faults += _find_freedom_faults(parameters, body["algorithm"]["population"])
        faults += self._find_term_count_faults(body, model)
        faults += _find_unused_parameters(tied, model_parameters, body["weights"])
        faults += self._find_repeated_recordings(body)
        faults += self._find_weight_faults(body, model)
        faults += self._find_channel_faults(body, model)
        faults += self._find_length_faults(body, tied, model_parameters)
        faults += self._find_sample_faults(body, model, parameters)
        faults += self._find_unit_faults(body, model)
        faults += _find_noise_faults(body, model)
        faults += warm_starts.find_warm_start_faults(self._session, body["warm_start"], model)
        return faults + list(find_signal_faults(body, model))

    def resolve_body(self, body: JobBody) -> JobBody:
        """Resolve a body: identifiers for datasets, the document for a model of its own."""
        model = self.resolve_model(body["model"])
        assert not isinstance(model, list)
        body = {**body, "model": model[1], "datasets": self.resolve_dataset_ids(body["datasets"])}
        body["warm_start"] = self.resolve_warm_start(body["warm_start"])
        if body["trend"] is not None:
            reference = self.resolve_warm_start(body["trend"]["reference"])
            body["trend"] = {**body["trend"], "reference": reference}
        validation = body["validation"]
        if validation is not None and validation["datasets"] is not None:
            body["validation"] = {
                **validation,
                "datasets": self.resolve_dataset_ids(validation["datasets"]),
            }
        return body

    def resolve_warm_start(self, reference: str | None) -> str | None:
        """Resolve the run that is meant now. Later acceptances do not change a queued job."""
        return warm_starts.resolve_warm_start(self._session, reference)

    def resolve_model(self, reference: Any) -> tuple[Model, Any] | list[FieldError]:
        """Return the model and the value to store for it, or its faults."""
        key = repr(reference)
        if key not in self._models:
            try:
                self._models[key] = models.resolve_model(self._session, reference)
            except SysidError as error:
                self._models[key] = [
                    fault_in_job(reference, fault) for fault in to_field_errors(error)
                ]
        return self._models[key]

    def resolve_dataset_ids(self, references: list[str]) -> list[str]:
        """List the identifiers of datasets that exist."""
        datasets = (self.get_dataset(reference) for reference in references)
        return [dataset.id for dataset in datasets if isinstance(dataset, Dataset)]

    def get_dataset(self, reference: str) -> Dataset | str:
        """Return the dataset with this identifier or name, or why there is none."""
        if reference not in self._datasets:
            self._datasets[reference] = resolve_dataset(self._session, reference)
        return self._datasets[reference]

    def _list_parameters(self, body: JobBody, model: Model) -> tuple[Parameter, ...]:
        """List the model's parameters and the initial states to be estimated in each experiment.

        If datasets are missing, the named experiments are counted instead.
        """
        pieces, is_complete = self._count_experiments(body, model)
        if not is_complete:
            pieces = max(
                pieces, min(count_named_experiments(body["parameters"]), MAX_NAMED_EXPERIMENTS)
            )
        return (*model.parameters, *build_initial_parameters(model, pieces))

    def _count_experiments(self, body: JobBody, model: Model) -> tuple[int, bool]:
        """Count the experiments of the datasets that exist; whether all do."""
        datasets = [self.get_dataset(reference) for reference in body["datasets"]]
        found = [dataset for dataset in datasets if isinstance(dataset, Dataset)]
        count = sum(count_dataset_experiments(one, model, body) for one in found)
        return count, len(found) == len(datasets)

    def _find_weight_faults(self, body: JobBody, model: Model) -> list[FieldError]:
        experiments, is_complete = self._count_experiments(body, model)
        return list(find_weight_count_faults(body, experiments)) if is_complete else []

    def _count_samples(self, body: JobBody) -> int:
        """Count the samples of all estimation datasets. A missing dataset counts as very long."""
        datasets = [self.get_dataset(reference) for reference in body["datasets"]]
        if not all(isinstance(dataset, Dataset) for dataset in datasets):
            return MAX_GENES
        return sum(dataset.n_samples for dataset in datasets if isinstance(dataset, Dataset))

    def _count_scored_samples(self, body: JobBody, model: Model) -> int:
        """Count the fitted samples of all outputs, if no dataset is missing."""
        fraction: float = (body["validation"] or {}).get("fraction") or 0.0
        samples = self._count_samples(body)
        skipped = body["skip"] * len(body["datasets"])
        return int(samples - round(fraction * samples) - skipped) * len(model.outputs)

    def _find_missing_datasets(self, body: JobBody) -> Iterator[FieldError]:
        for pointer, reference in _list_dataset_references(body):
            dataset = self.get_dataset(reference)
            if isinstance(dataset, str):
                yield FieldError(pointer, dataset)

    def _find_repeated_recordings(self, body: JobBody) -> Iterator[FieldError]:
        """Report datasets that are named twice, or used for both estimation and validation."""
        places: dict[str, tuple[str, str]] = {}
        for pointer, reference in _list_dataset_references(body):
            dataset = self.get_dataset(reference)
            if isinstance(dataset, str):
                continue
            first, name = places.setdefault(dataset.sha256, (pointer, reference))
            if first != pointer:
                yield FieldError(
                    pointer,
                    f"{reference!r} is the same recording as {name!r} at {first}. "
                    "Name another, or leave it out",
                )

    def _find_unit_faults(self, body: JobBody, model: Model) -> Iterator[FieldError]:
        return find_unit_faults(model, body["channels"], self._list_datasets(body))

    def _find_channel_faults(self, body: JobBody, model: Model) -> Iterator[FieldError]:
        yield from find_channels_given_twice(body["channels"], model)
        for _, dataset in self._list_datasets(body):
            yield from find_channel_faults(body["channels"], model, dataset)

    def _find_length_faults(
        self, body: JobBody, model: Model, parameters: tuple[Parameter, ...]
    ) -> Iterator[FieldError]:
        fraction: float | None = (body["validation"] or {}).get("fraction")
        for pointer, dataset in self._list_datasets(body):
            for piece in list_record_lengths(dataset):
                estimated = piece if fraction is None else piece.take_estimation_part(fraction)
                if estimated is not None:
                    yield from find_length_faults(
                        pointer, model, parameters, estimated, body["skip"]
                    )
                else:
                    yield FieldError(
                        "/validation/fraction",
                        f"found {fraction!r}: with {piece.samples} samples, one part of the record "
                        "would be empty",
                    )

    def _find_term_count_faults(self, body: JobBody, model: Model) -> list[FieldError]:
        faults: list[FieldError] = []
        if model.rule is not None:
            collect_faults(
                check_candidate_count, faults, len(model.terms), self._count_samples(body)
            )
        return faults

    def _find_sample_faults(
        self, body: JobBody, model: Model, parameters: tuple[Parameter, ...]
    ) -> Iterator[FieldError]:
        # Not all candidate terms are selected: `check_candidate_count` checks those models.
        if model.rule is None:
            yield from _check_sample_count(parameters, self._count_scored_samples(body, model))

    def _list_datasets(self, body: JobBody) -> list[tuple[str, Dataset]]:
        """List the existing datasets of a body with their pointers."""
        datasets = (
            (pointer, self.get_dataset(reference))
            for pointer, reference in _list_dataset_references(body)
        )
        return [(pointer, dataset) for pointer, dataset in datasets if isinstance(dataset, Dataset)]


def find_type_faults(pointer: str, body: JobBody) -> list[FieldError]:
    """Report type faults of a body into which a sweep put a value."""
    try:
        JobIn.model_validate(body)
    except ValidationError as error:
        faults = explain_errors(error.errors(), body, JobIn)
        return [FieldError(pointer, str(fault)) for fault in faults]
    return []


def _find_unused_parameters(
    model: Model, parameters: tuple[Parameter, ...], weights: Weights | None
) -> list[FieldError]:
    """Report parameters that affect no output, and similar unused settings."""
    return [
        FieldError(fault.pointer, fault.detail)
        for fault in find_unused_settings(model, parameters, weights)
    ]


def _find_noise_faults(body: JobBody, model: Model) -> list[FieldError]:
    """Find why noise has no place inside the plant."""
    noise, faults = read_noise(body), list[FieldError]()
    if noise.place == "plant":
        # This import loads the compiler, which most requests never need.
        from sysid.simulation.process_noise import check_process_noise

        collect_faults(check_process_noise, faults, model, noise)
    return faults


def _list_dataset_references(body: JobBody) -> Iterator[tuple[str, str]]:
    for index, reference in enumerate(body["datasets"]):
        yield f"/datasets/{index}", reference
    for index, reference in enumerate((body["validation"] or {}).get("datasets") or []):
        yield f"/validation/datasets/{index}", reference


def _check_sample_count(parameters: tuple[Parameter, ...], samples: int) -> Iterator[FieldError]:
    free = sum(parameter.is_free for parameter in parameters)
    if 0 < samples < free:
        yield FieldError(
            "/datasets",
            f"the records have {samples} scored samples for {free} free parameters. Give at "
            "least as many samples, or fix some parameters",
        )


def _find_freedom_faults(
    parameters: tuple[Parameter, ...], population: int
) -> Iterator[FieldError]:
    free = [parameter for parameter in parameters if parameter.is_free]
    if not free:
        yield FieldError("/parameters", "every parameter is fixed. Leave at least one free")
    if population * len(free) > MAX_GENES:
        yield FieldError(
            "/algorithm/population",
            f"found {population} individuals with {len(free)} free parameters. At most "
            f"{MAX_GENES // len(free)} individuals fit into memory",
        )


def fault_in_job(reference: Any, fault: FieldError) -> FieldError:
    """Move the fault of a model to its pointer in the job that names or contains the model."""
    if isinstance(reference, Mapping):
        return FieldError("/model" + fault.pointer, fault.detail, fault.column)
    return fault
