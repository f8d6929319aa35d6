"""Read what lists of jobs tell of results: parts of the result of one run for each job."""

from collections.abc import Sequence
from typing import NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.storage.columns import Document
from service.storage.tables import Job, Run


class OutcomeRow(NamedTuple):
    """The only run of a job, or its best one by RMS, with parts of its result."""

    job: str
    run: str
    fit_estimation: float | None
    fit_validation: float | None
    parts: Document


def read_outcome_rows(
    session: Session, jobs: Sequence[Job], parts: Sequence[str]
) -> list[OutcomeRow]:
    """Read one row for each of these jobs that has a run with a result.

    The only runs come by one query. The best of many is the first of an index, a query for each
    job. No other result is read.
    """
    single = [job.id for job in jobs if job.n_runs == 1 and job.n_done]
    chosen = [_find_best(session, job.id) for job in jobs if job.n_runs > 1 and job.n_done]
    condition = (Run.job_id.in_(single) & (Run.number == 0)) | Run.id.in_(filter(None, chosen))
    columns = [Run.result.expression[part] for part in parts]
    query = select(Run.job_id, Run.id, Run.fit_estimation, Run.fit_validation, *columns).where(
        condition, Run.state == JobState.SUCCEEDED, Run.deleted_at.is_(None)
    )
    return [
        OutcomeRow(job, run, fit, validated, dict(zip(parts, values, strict=True)))
        for job, run, fit, validated, *values in session.execute(query)
    ]


def _find_best(session: Session, job: str) -> str | None:
    query = select(Run.id).where(
        Run.job_id == job, Run.best_rms.is_not(None), Run.deleted_at.is_(None)
    )
    return session.scalar(query.order_by(Run.best_rms, Run.number).limit(1))
