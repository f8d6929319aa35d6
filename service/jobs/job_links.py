"""What a job was made from, and under which terms lists find it. Both follow from its request."""

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Any

from sqlalchemy.orm import Session

from service.core.bodies.job_fields import DATASETS_PATH, WARM_START_PATH
from service.items.reference_names import RUN_PREFIX
from service.repositories.lineage_rows import LineageRepository, Relation
from service.repositories.model_rows import ModelRepository
from service.repositories.search_conditions import Term, add_terms, list_label_terms
from service.storage.tables import Job

Spec = Mapping[str, Any]


def store_job_links(session: Session, job: Job) -> None:
    """Store the lineage and the search terms of a job that was just queued."""
    add_terms(session, "job", job.id, list_job_terms(job.spec), job.project_id)
    lineage = LineageRepository(session, job.project_id)
    for relation, parents in _list_parents(session, job).items():
        lineage.add_links(job.id, dict.fromkeys(parents), relation)


def list_used_datasets(spec: Spec) -> tuple[str, ...]:
    """List the datasets of all runs of a job, for estimation and validation."""
    return tuple(dict.fromkeys(chain(_list_estimation(spec), _list_validation(spec))))


def list_used_runs(spec: Spec) -> tuple[str, ...]:
    """List the earlier runs from which runs of a job start, or with which it is compared."""
    return tuple(dict.fromkeys(chain(_list_warm_starts(spec), _list_references(spec))))


def list_job_terms(spec: Spec) -> Iterator[Term]:
    """List the terms under which a job is found: model, datasets, labels."""
    yield "model", find_model_name(spec)
    for dataset in list_used_datasets(spec):
        yield "dataset", dataset
    for axis in spec["sweep"]["axes"]:
        for labels in axis.get("labels") or ():
            yield from list_label_terms(labels or {})


def find_model_name(spec: Spec) -> str:
    """Return the name of a job's model, without its version."""
    model = spec["model"]
    return str(model["name"] if isinstance(model, Mapping) else model)


def _list_parents(session: Session, job: Job) -> dict[Relation, list[str]]:
    spec, model = job.spec, job.spec["model"]
    stored = None
    if isinstance(model, Mapping):
        stored = ModelRepository(session, job.project_id).find_document(
            str(model["name"]), dict(model)
        )
    return {
        "estimation": list(_list_estimation(spec)),
        "validation": list(_list_validation(spec)),
        "warm-start": list(_list_warm_starts(spec)),
        "reference": list(_list_references(spec)),
        "model": [] if stored is None else [stored.id],
    }


def _list_estimation(spec: Spec) -> Iterator[str]:
    yield from spec["datasets"]
    for value in _list_axis_values(spec, DATASETS_PATH):
        yield from [value] if isinstance(value, str) else value


def _list_validation(spec: Spec) -> Iterator[str]:
    yield from (spec["validation"] or {}).get("datasets") or ()
    for value in _list_axis_values(spec, "/validation/datasets"):
        yield from [value] if isinstance(value, str) else value or ()


def _list_warm_starts(spec: Spec) -> Iterator[str]:
    for value in (spec["warm_start"], *_list_axis_values(spec, WARM_START_PATH)):
        if str(value).startswith(RUN_PREFIX):
            yield value


def _list_references(spec: Spec) -> Iterator[str]:
    reference = (spec["trend"] or {}).get("reference")
    if reference is not None:
        yield reference


def _list_axis_values(spec: Spec, path: str) -> Iterator[Any]:
    """Iterate over the values of the axes at this field or below it."""
    for axis in spec["sweep"]["axes"]:
        if axis["path"] == path or axis["path"].startswith(f"{path}/"):
            yield from axis.get("values") or ()
