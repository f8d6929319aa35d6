"""Stored items of every kind: look up, lock, name, and version of what can be edited."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.core.errors import NotFound, StaleVersion
from service.repositories.job_rows import JobRepository
from service.repositories.model_rows import ModelRepository
from service.repositories.reference_rows import ReferenceRepository
from service.repositories.run_rows import RunRepository
from service.repositories.search_conditions import ItemKind
from service.storage.sessions import find_project
from service.storage.storage_errors import RowNotFound
from service.storage.tables import (
    AcceptedReference,
    Dataset,
    Job,
    ModelVersion,
    Run,
)

ItemRow: TypeAlias = Job | Run | Dataset | ModelVersion | AcceptedReference


@dataclass(frozen=True, slots=True)
class Item:
    """A stored item.

    Attributes
    ----------
    rows : tuple
        Its row. A model has those of all versions, or the one of ``name@version``. A reference has
        those of its acceptances, the latest first.
    """

    kind: ItemKind
    id: str
    name: str
    rows: tuple[ItemRow, ...]

    @property
    def row(self) -> ItemRow:
        """The row that is edited."""
        return self.rows[0]


def lock_item(
    session: Session, kind: ItemKind, reference: str, *, is_deleted: bool = False
) -> Item:
    """Look up an item that nobody else can change until the session ends.

    With a run that is to be deleted, its job is locked too. Else its job is only kept: a dispatcher
    changes a run first and then its job, so it would wait for us, and we for it.

    Raises
    ------
    NotFound, RowNotFound
        If there is none.
    """
    rows: Sequence[ItemRow]
    match kind:
        case "job":
            job = JobRepository(session).lock(reference)
            return Item(kind, job.id, job.name, (job,))
        case "run":
            run = RunRepository(session).get(reference)
            jobs = JobRepository(session)
            if not is_deleted:
                jobs.share_lock(run.job_id)
                RunRepository(session).lock(reference)
            job = (jobs.lock if is_deleted else jobs.get)(run.job_id)
            run = RunRepository(session).get(reference)
            return Item(kind, run.id, f"run {run.number + 1} of {job.name}", (run,))
        case "dataset":
            query = select(Dataset).where(
                Dataset.id == reference,
                Dataset.project_id == find_project(session),
                Dataset.deleted_at.is_(None),
            )
            dataset = session.scalar(
                query.with_for_update(), execution_options={"populate_existing": True}
            )
            if dataset is None:
                raise RowNotFound("dataset", reference)
            return Item(kind, dataset.id, dataset.name, (dataset,))
        case "model":
            return _lock_model(session, reference)
        case "reference":
            rows = ReferenceRepository(session).lock(reference)
            return Item(kind, reference, reference, tuple(rows))


def _lock_model(session: Session, reference: str) -> Item:
    models = ModelRepository(session)
    try:
        row = models.get(reference)
    except RowNotFound:
        hint = "; a built-in model cannot be changed" if "@" not in reference else ""
        raise NotFound("model of your own", reference, hint) from None
    session.execute(select(ModelVersion.id).where(ModelVersion.id == row.id).with_for_update())
    is_whole = reference == row.name
    rows = tuple(models.list_versions(row.name)) if is_whole else (row,)
    return Item("model", reference if is_whole else f"{row.name}@{row.version}", row.name, rows)


def compute_etag(row: ItemRow) -> str:
    """Return the version of what can be edited: name, note and tags."""
    text = json.dumps([getattr(row, "name", None), row.note, row.tags or []])
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'


def check_version(row: ItemRow, if_match: str | None) -> None:
    """Refuse a change of a version that is not the present one.

    Raises
    ------
    StaleVersion
        If the header names other versions.
    """
    if if_match is None:
        return
    etag, named = compute_etag(row), [text.strip() for text in if_match.split(",")]
    if etag not in named and named != ["*"]:
        raise StaleVersion(
            f"name, note or tags have ETag {etag} now; If-Match asks for {if_match:.200}. "
            "Read it again, and repeat the change if it still makes sense"
        )
