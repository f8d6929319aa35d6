"""List the datasets of a job for pages and reports, each with its role and label."""

from collections.abc import Iterator
from itertools import islice
from typing import Any

from sqlalchemy.orm import Session

from service.core.bodies.job_fields import DATASETS_PATH
from service.core.label_text import format_labels
from service.pages.views import sweep_axes
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.lineage_rows import LineageRepository
from service.storage.columns import Document
from service.storage.storage_errors import RowNotFound
from service.storage.tables import Job

MAX_LISTED_DATASETS = 100
"""Most datasets of a job that are listed."""


def dataset_links(session: Session, job: Job) -> list[dict[str, Any]]:
    """List the datasets of a job: role, label, name, what was subtracted, and parents."""
    lineage = LineageRepository(session)
    return [
        {
            "role": role,
            "label": label,
            "id": dataset_id,
            **_describe_dataset(session, dataset_id),
            "parents": [
                e.parent for e in lineage.list_ancestors(dataset_id) if e.child == dataset_id
            ],
        }
        for role, label, dataset_id in islice(_iterate_datasets(job.spec), MAX_LISTED_DATASETS)
    ]


def count_unlisted_datasets(job: Job) -> int:
    """Count the datasets of a job that are not listed."""
    return max(0, sum(1 for _ in _iterate_datasets(job.spec)) - MAX_LISTED_DATASETS)


def _iterate_datasets(spec: Document) -> Iterator[tuple[str, str, str]]:
    """Yield role, label and id of each dataset; datasets of an axis replace the job's."""
    axes = [
        axis for axis in sweep_axes(spec) if axis["path"] == DATASETS_PATH and axis.get("values")
    ]
    for axis in axes:
        labels = axis["labels"] or [{}] * len(axis["values"])
        for value, label in zip(axis["values"], labels, strict=True):
            for dataset in [value] if isinstance(value, str) else value:
                yield "estimation", format_labels(label), dataset
    if not axes:
        for dataset in spec["datasets"]:
            yield "estimation", "", dataset
    for dataset in (spec["validation"] or {}).get("datasets") or []:
        yield "validation", "", dataset


def _describe_dataset(session: Session, dataset_id: str) -> dict[str, Any]:
    try:
        dataset = DatasetRepository(session).get(dataset_id)
    except RowNotFound:
        return {"name": "deleted", "subtracted": []}
    return {"name": dataset.name, "subtracted": dataset.details.get("subtracted") or []}
