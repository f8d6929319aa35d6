"""Results of runs of any jobs, page by page: the latest job first, its runs in their order."""

from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import Any, NamedTuple

from sqlalchemy import Select, exists, select
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.repositories.job_rows import JobRepository
from service.repositories.outcome_rows import match_outcomes
from service.repositories.search_conditions import NO_FILTER, ListFilter, select_ids
from service.storage.columns import Document
from service.storage.sessions import find_project
from service.storage.statements import RowPage
from service.storage.storage_errors import InvalidCursor, RowNotFound
from service.storage.tables import Job, Run
from sysid.core.value_documents import decode
from sysid.uncertainty.estimates import Estimate

JOBS_AT_ONCE = 100
MAX_JOBS = 2000
"""Most jobs that one page looks at; the next page goes on."""


class ResultRow(NamedTuple):
    """A successful run with its estimates."""

    job: Job
    run: str
    number: int
    labels: Document
    cell: Document
    fit_estimation: float | None
    finished_at: datetime | None
    estimates: Sequence[Estimate]


_COLUMNS = (
    Run.job_id,
    Run.id,
    Run.number,
    Run.labels,
    Run.cell,
    Run.fit_estimation,
    Run.finished_at,
    Run.result.expression["parameters"],
)


def list_results(
    session: Session,
    *,
    cursor: str | None = None,
    limit: int = 100,
    chosen: ListFilter = NO_FILTER,
    only_best: bool = False,
) -> RowPage[ResultRow]:
    """List the successful runs of the jobs that meet a filter.

    Parameters
    ----------
    cursor : str, optional
        Job and number of the last run of the previous page.
    only_best : bool
        Whether one run stands for each job, the best by RMS.
    """
    rows: list[ResultRow] = []
    job_cursor, last = None, -1
    if cursor is not None:
        job, last = _read_cursor(session, cursor)
        job_cursor = job.id
        if not only_best:
            rows += _list_runs(session, job, last, limit + 1)
    looked_at, following = _list_jobs(session, job_cursor, chosen)
    for start in range(0, len(looked_at), JOBS_AT_ONCE):
        if len(rows) > limit:
            break
        jobs = _load_jobs_with_results(session, looked_at[start : start + JOBS_AT_ONCE])
        rows += _list_runs_of_jobs(session, jobs, limit + 1 - len(rows), only_best=only_best)
    return _make_page(rows, limit, following)


def _list_jobs(
    session: Session, cursor: str | None, chosen: ListFilter
) -> tuple[Sequence[str], str | None]:
    """List the jobs that a page looks at, and where the next page goes on if there are more."""
    query = select_ids(Job, find_project(session), chosen, cursor=cursor, limit=MAX_JOBS)
    ids = session.scalars(query).all()
    looked_at = ids[:MAX_JOBS]
    return looked_at, f"{looked_at[-1]}:{_AFTER_ALL}" if len(ids) > MAX_JOBS else None


def _load_jobs_with_results(session: Session, ids: Sequence[str]) -> Sequence[Job]:
    """Load those of these jobs that have a run with a result, latest first."""
    has_result = exists().where(
        Run.job_id == Job.id, Run.state == JobState.SUCCEEDED, Run.deleted_at.is_(None)
    )
    query = select(Job).where(Job.id.in_(ids), Job.n_done > Job.n_failed, has_result)
    return session.scalars(query.order_by(Job.id.desc())).all()


_AFTER_ALL = 2**31 - 1
"""A number that no run reaches: the next page begins with the next job."""


def _make_page(rows: list[ResultRow], limit: int, following: str | None) -> RowPage[ResultRow]:
    if len(rows) <= limit:
        return RowPage(tuple(rows), following)
    last = rows[limit - 1]
    return RowPage(tuple(rows[:limit]), f"{last.job.id}:{last.number}")


def _read_cursor(session: Session, cursor: str) -> tuple[Job, int]:
    name, _, number = cursor.partition(":")
    if not number.isascii() or not number.isdecimal() or int(number) > _AFTER_ALL:
        raise InvalidCursor(cursor)
    try:
        return JobRepository(session).get(name), int(number)
    except RowNotFound:
        raise InvalidCursor(cursor) from None


def _list_runs_of_jobs(
    session: Session, jobs: Sequence[Job], room: int, *, only_best: bool
) -> list[ResultRow]:
    """List runs of these jobs. One query reads all that stand for their job alone."""
    alone = [job for job in jobs if only_best or job.n_runs == 1]
    query = _select_succeeded().where(match_outcomes(session, alone))
    found = _read_rows(session, query, {job.id: job for job in jobs})
    of_job = {row.job.id: [row] for row in found}
    rows: list[ResultRow] = []
    for job in jobs:
        if len(rows) >= room:
            break
        if job.n_runs > 1 and not only_best:
            rows += _list_runs(session, job, -1, room - len(rows))
        else:
            rows += of_job.get(job.id, [])
    return rows


def _list_runs(session: Session, job: Job, last: int, limit: int) -> list[ResultRow]:
    query = _select_succeeded().where(Run.job_id == job.id, Run.number > last)
    return list(_read_rows(session, query.order_by(Run.number).limit(limit), {job.id: job}))


def _select_succeeded() -> Select[Any]:
    return select(*_COLUMNS).where(Run.state == JobState.SUCCEEDED, Run.deleted_at.is_(None))


def _read_rows(session: Session, query: Select[Any], jobs: dict[str, Job]) -> Iterator[ResultRow]:
    for job, run, number, labels, cell, fit, ended, parameters in session.execute(query):
        estimates = decode(tuple[Estimate, ...], parameters or [])
        yield ResultRow(jobs[job], run, number, labels, cell, fit, ended, estimates)
