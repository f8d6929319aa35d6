"""Objects that no row refers to, and rows whose object is missing: ``lagid db check``.

Store and tables are compared in parts, so that memory does not grow with the number of objects.
"""

import random
from collections.abc import Collection, Iterator
from datetime import datetime, timedelta
from itertools import product
from typing import Any

from sqlalchemy import ColumnElement, Select, or_, select
from sqlalchemy.orm import Session

from service.storage.columns import utc_now
from service.storage.objects import RENEWAL_AGE, ObjectStore, StoredObject
from service.storage.sessions import Database, release_connection
from service.storage.statements import split_chunks
from service.storage.storage_errors import ObjectDamaged, ObjectMissing
from service.storage.tables import Dataset, Job, Run

MINIMUM_AGE = 2 * RENEWAL_AGE
"""An object may be older by this time than the row that will refer to it."""
PREFIXES = tuple("".join(digits) for digits in product("0123456789abcdef", repeat=2))
"""First digits of the hashes: the folders of the store."""


def find_orphans(
    session: Session, store: ObjectStore, older_than: timedelta = MINIMUM_AGE
) -> Iterator[StoredObject]:
    """Yield the objects that no row refers to and that are too old to wait for one."""
    limit = utc_now() - older_than  # what was deleted later may be in a backup that is written now
    old = (
        item
        for item in store.list_objects()
        if item.modified_at is None or item.modified_at < limit
    )
    for items in split_chunks(old):
        named = _find_named_hashes(session, [item.sha256 for item in items], limit)
        release_connection(session)  # the store may take its time
        yield from (item for item in items if item.sha256 not in named)


def find_lost_hashes(session: Session, store: ObjectStore) -> Iterator[str]:
    """Yield the hashes that rows refer to, but that the store does not have, in order."""
    for prefix in PREFIXES:
        named: set[str | None] = set()
        for query in select_hashes():
            column = query.selected_columns[0]
            part = query.where(column >= prefix, column < f"{prefix}g").distinct()
            named.update(session.scalars(part))
        release_connection(session)  # the store may take its time
        # Listed after the rows were read: an object is written before its row.
        named.difference_update(item.sha256 for item in store.list_objects(prefix))
        yield from sorted(filter(None, named))


def find_damaged(store: ObjectStore, share: float = 1.0) -> Iterator[tuple[str, bool]]:
    """Read the objects, or a random share of them; yield each hash and whether it is damaged."""
    for item in store.list_objects():
        if share >= 1.0 or random.random() < share:
            try:
                store.check_object(item.sha256)
            except ObjectDamaged:
                yield item.sha256, True
            except ObjectMissing:  # it was deleted meanwhile
                continue
            else:
                yield item.sha256, False


def delete_orphans(
    database: Database, store: ObjectStore, older_than: timedelta = MINIMUM_AGE
) -> tuple[int, int]:
    """Delete the orphans; return how many objects and bytes were deleted.

    The rows are looked up again right before each delete, and so is the age of the object.
    """
    limit, n_deleted, freed = utc_now() - older_than, 0, 0
    with database.read_session() as session:
        for orphan in find_orphans(session, store, older_than):
            with database.read_session() as later:  # a new one sees new rows
                is_named = bool(_find_named_hashes(later, [orphan.sha256], limit))
            if not is_named and store.delete_older(orphan.sha256, limit):
                n_deleted, freed = n_deleted + 1, freed + orphan.size
    return n_deleted, freed


def _find_named_hashes(
    session: Session, hashes: Collection[str], limit: datetime | None = None
) -> set[str]:
    """Return those of the hashes that rows refer to which were not deleted before `limit`."""
    return {
        sha256
        for query in select_hashes(limit)
        for sha256 in session.scalars(query.where(query.selected_columns[0].in_(hashes)))
        if sha256 is not None
    }


def select_hashes(limit: datetime | None = None) -> tuple[Select[str], Select[str | None]]:
    """Select the hashes of datasets and of runs that were not deleted, or not before `limit`."""
    datasets = select(Dataset.sha256).where(_is_kept(Dataset.deleted_at, limit))
    runs = select(Run.signals_sha256).join(Job, Job.id == Run.job_id)
    return datasets, runs.where(
        Run.signals_sha256.is_not(None),
        _is_kept(Job.deleted_at, limit),
        _is_kept(Run.deleted_at, limit),
    )


def _is_kept(deleted_at: Any, limit: datetime | None) -> ColumnElement[bool]:
    return or_(deleted_at.is_(None), *([] if limit is None else [deleted_at >= limit]))
