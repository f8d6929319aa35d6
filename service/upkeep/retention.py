"""Delete ended jobs and audit entries after their time, and remove what deleted jobs leave.

Removal waits for `MINIMUM_AGE`, as that of objects does: a backup that is being written, or a run
that is taken over, may still read what was just deleted.
"""

from collections.abc import Sequence
from datetime import datetime, timedelta
from itertools import takewhile
from typing import Any

from sqlalchemy import delete, exists, null, or_, select, update
from sqlalchemy.orm import Session

from service.core.errors import Conflict
from service.core.states import OPEN_STATES
from service.items.deletion import HasDependents, delete_item
from service.storage.columns import utc_now
from service.storage.garbage import MINIMUM_AGE
from service.storage.sessions import Database, SessionOwner, find_project
from service.storage.statements import split_chunks
from service.storage.storage_errors import RowNotFound
from service.storage.tables import (
    AuditEntry,
    Checkpoint,
    Dataset,
    Event,
    Job,
    LineageEdge,
    MigrationLog,
    Project,
    Run,
    RunHistory,
    StoredSummary,
)

MAX_JOBS = 100
"""Jobs that one pass looks at."""
ROWS_AT_ONCE = 500
"""Runs or events that one transaction removes: others write in between."""


def delete_expired_jobs(
    database: Database, default_days: float | None, now: datetime | None = None
) -> list[str]:
    """Delete the jobs that ended long ago, with what only they use; return all identifiers.

    Datasets are deleted that such a job used, that are as old, and from which nothing else was
    made. A job is kept while something else was made from it, such as a reference.

    Parameters
    ----------
    default_days : float or None
        Days that jobs are kept in projects without a rule of their own. None: for ever.
    """
    deleted: list[str] = []
    with database.read_session() as session:
        projects = session.execute(select(Project.id, Project.keep_days)).all()
    for project, days in projects:
        kept_days = default_days if days is None else days
        if not kept_days:
            continue
        limit = (now or utc_now()) - timedelta(days=kept_days)
        after: str | None = None
        owned = database.open_for(SessionOwner(project))
        while True:
            with owned.read_session() as session:
                jobs = list_ended_jobs(session, limit, after)
            for job in jobs:
                deleted += _delete_expired(owned, job, limit)
            if len(jobs) < MAX_JOBS:
                break
            after = jobs[-1]
    return deleted


def delete_expired_actions(
    database: Database, days: float | None, now: datetime | None = None
) -> int:
    """Delete the entries of the audit log that are older than `days`; return their number.

    They are read in the order of their numbers, which is that of time, up to the first that stays.
    """
    if days is None:
        return 0
    limit, n_deleted = (now or utc_now()) - timedelta(days=days), 0
    while True:
        oldest = select(AuditEntry.id, AuditEntry.at).order_by(AuditEntry.id).limit(ROWS_AT_ONCE)
        with database.write_session() as session:
            rows = session.execute(oldest).all()
            expired = [number for number, _ in takewhile(lambda row: row.at < limit, rows)]
            session.execute(delete(AuditEntry).where(AuditEntry.id.in_(expired)))
        n_deleted += len(expired)
        if len(expired) < ROWS_AT_ONCE:
            return n_deleted


def list_ended_jobs(session: Session, limit: datetime, after: str | None = None) -> Sequence[str]:
    """List jobs of the session's project that ended before a time, the first to end first."""
    query = select(Job.id).where(
        Job.project_id == find_project(session), Job.deleted_at.is_(None), Job.finished_at < limit
    )
    if after is not None:
        last = select(Job.finished_at).where(Job.id == after).scalar_subquery()
        query = query.where(
            or_(Job.finished_at > last, (Job.finished_at == last) & (Job.id > after))
        )
    return session.scalars(query.order_by(Job.finished_at, Job.id).limit(MAX_JOBS)).all()


def list_deleted_jobs(session: Session, limit: datetime) -> Sequence[str]:
    """List jobs that were deleted before a time, and whose runs are still stored."""
    query = select(Job.id).where(
        Job.deleted_at.is_not(None), Job.purged_at.is_(None), Job.deleted_at < limit
    )
    return session.scalars(query.order_by(Job.deleted_at).limit(MAX_JOBS)).all()


def purge_deleted_jobs(database: Database, older_than: timedelta = MINIMUM_AGE) -> int:
    """Remove the runs, events and requests of deleted jobs; return how many runs were removed.

    The row of the job stays, as the tombstone that lineage names.
    """
    limit, n_runs = utc_now() - older_than, 0
    with database.read_session() as session:
        jobs = list_deleted_jobs(session, limit)
    for job in jobs:
        n_runs += _purge_job(database, job)
    return n_runs


def _delete_expired(database: Database, job_id: str, limit: datetime) -> list[str]:
    with database.write_session() as session:
        query = select(LineageEdge.parent).where(
            LineageEdge.child == job_id, LineageEdge.parent.startswith("ds_", autoescape=True)
        )
        datasets = session.scalars(query.distinct().order_by(LineageEdge.parent)).all()
        if not _try_delete(session, "job", job_id):
            return []
        old = select(Dataset.id).where(Dataset.id.in_(datasets), Dataset.created_at < limit)
        gone = [
            dataset
            for dataset in session.scalars(old.order_by(Dataset.id.desc())).all()
            if _try_delete(session, "dataset", dataset)
        ]
        return [job_id, *gone]


def _try_delete(session: Session, kind: Any, identity: str) -> bool:
    """Delete an item from which nothing was made; return whether it was deleted."""
    try:
        delete_item(session, kind, identity)
    except (HasDependents, Conflict, RowNotFound):  # it is used, open again, or gone
        return False
    return True


def _purge_job(database: Database, job_id: str) -> int:
    n_runs = 0
    with database.read_session() as session:
        of_job = select(Run.id).where(Run.job_id == job_id)
        runs = session.scalars(of_job.order_by(Run.number)).all()
    for chunk in split_chunks(runs, ROWS_AT_ONCE):
        with database.write_session() as session:
            for table in (RunHistory, MigrationLog, Checkpoint):
                session.execute(delete(table).where(table.run_id.in_(chunk)))
            session.execute(delete(Run).where(Run.id.in_(chunk)))
        n_runs += len(chunk)
    while True:
        events = select(Event.id).where(Event.job_id == job_id).limit(ROWS_AT_ONCE)
        with database.write_session() as session:
            numbers = session.scalars(events).all()
            session.execute(delete(Event).where(Event.id.in_(numbers)))
        if len(numbers) < ROWS_AT_ONCE:
            break
    with database.write_session() as session:
        session.execute(delete(StoredSummary).where(StoredSummary.job_id == job_id))
        left = exists(select(1).where(Run.job_id == job_id))
        done = update(Job).where(Job.id == job_id, Job.state.not_in(OPEN_STATES), ~left)
        session.execute(
            done.values(spec={}, cramer_rao=null(), purged_at=utc_now()),
            execution_options={"synchronize_session": False},
        )
    return n_runs
