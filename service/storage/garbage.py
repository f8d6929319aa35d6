"""Objects that no row names, and rows whose object is gone: ``lagid db check``."""

from collections.abc import Iterator
from datetime import timedelta

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.storage.columns import utc_now
from service.storage.objects import ObjectStore, StoredObject
from service.storage.tables import Dataset, Job, Run

MINIMUM_AGE = timedelta(hours=1)
"""An object may be this much older than the row that is about to name it."""


def list_named_hashes(session: Session) -> set[str]:
    """Hashes of the objects that the rows which were not deleted name."""
    datasets = select(Dataset.sha256).where(Dataset.deleted_at.is_(None))
    runs = (
        select(Run.signals_sha256)
        .join(Job, Job.id == Run.job_id)
        .where(Run.signals_sha256.is_not(None), Job.deleted_at.is_(None))
    )
    found = set(session.scalars(datasets))
    found.update(sha256 for sha256 in session.scalars(runs) if sha256 is not None)
    return found


def find_orphans(
    session: Session, store: ObjectStore, older_than: timedelta = MINIMUM_AGE
) -> Iterator[StoredObject]:
    """Objects that no row names and that are too old to be waiting for one."""
    keep, limit = list_named_hashes(session), utc_now() - older_than
    for one in store.list_objects():
        if one.sha256 not in keep and (one.modified_at is None or one.modified_at < limit):
            yield one


def find_lost_hashes(session: Session, store: ObjectStore) -> set[str]:
    """Hashes that rows name but the store does not have."""
    return list_named_hashes(session) - {one.sha256 for one in store.list_objects()}


def delete_orphans(
    session: Session, store: ObjectStore, older_than: timedelta = MINIMUM_AGE
) -> int:
    """Delete the orphans; how many bytes that freed."""
    freed = 0
    for one in list(find_orphans(session, store, older_than)):
        store.delete(one.sha256)
        freed += one.size
    return freed
