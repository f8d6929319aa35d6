"""Objects that no row refers to, and rows whose object is missing: ``lagid db check``."""

from collections.abc import Iterator
from datetime import timedelta

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.storage.columns import utc_now
from service.storage.objects import RENEWAL_AGE, ObjectStore, StoredObject
from service.storage.sessions import Database
from service.storage.tables import Dataset, Job, Run

MINIMUM_AGE = 2 * RENEWAL_AGE
"""An object may be older by this time than the row that will refer to it."""


def list_named_hashes(session: Session) -> set[str]:
    """List the hashes of all objects that undeleted rows refer to."""
    datasets = select(Dataset.sha256).where(Dataset.deleted_at.is_(None))
    runs = (
        select(Run.signals_sha256)
        .join(Job, Job.id == Run.job_id)
        .where(Run.signals_sha256.is_not(None), Job.deleted_at.is_(None))
    )
    hashes = set(session.scalars(datasets))
    hashes.update(sha256 for sha256 in session.scalars(runs) if sha256 is not None)
    return hashes


def find_orphans(
    session: Session, store: ObjectStore, older_than: timedelta = MINIMUM_AGE
) -> Iterator[StoredObject]:
    """Yield the objects that no row refers to and that are too old to wait for one."""
    named, limit = list_named_hashes(session), utc_now() - older_than
    for item in store.list_objects():
        if item.sha256 not in named and (item.modified_at is None or item.modified_at < limit):
            yield item


def find_lost_hashes(session: Session, store: ObjectStore) -> set[str]:
    """Return the hashes that rows refer to, but that the store does not have."""
    return list_named_hashes(session) - {item.sha256 for item in store.list_objects()}


def delete_orphans(
    database: Database, store: ObjectStore, older_than: timedelta = MINIMUM_AGE
) -> tuple[int, int]:
    """Delete the orphans; return how many objects and bytes were deleted.

    The rows are looked up again right before each delete, and so is the age of the object.
    """
    limit, n_deleted, freed = utc_now() - older_than, 0, 0
    with database.read_session() as session:
        orphans = list(find_orphans(session, store, older_than))
    for orphan in orphans:
        with database.read_session() as session:  # a new one sees new rows
            is_named = _is_named(session, orphan.sha256)
        if not is_named and store.delete_older(orphan.sha256, limit):
            n_deleted, freed = n_deleted + 1, freed + orphan.size
    return n_deleted, freed


def _is_named(session: Session, sha256: str) -> bool:
    dataset = select(Dataset.id).where(Dataset.sha256 == sha256, Dataset.deleted_at.is_(None))
    run = (
        select(Run.id)
        .join(Job, Job.id == Run.job_id)
        .where(Run.signals_sha256 == sha256, Job.deleted_at.is_(None))
    )
    return any(session.scalar(query.limit(1)) is not None for query in (dataset, run))
