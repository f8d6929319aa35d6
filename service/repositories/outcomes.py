"""What lists of jobs tell of results: one run stands for each job, and parts of its result."""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from service.core.job_fields import DATASETS_PATH
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
    chosen = [
        session.scalar(select_best_run(job.id)) for job in jobs if job.n_runs > 1 and job.n_done
    ]
    condition = (Run.job_id.in_(single) & (Run.number == 0)) | Run.id.in_(filter(None, chosen))
    columns = [Run.result.expression[part] for part in parts]
    query = select(Run.job_id, Run.id, Run.fit_estimation, Run.fit_validation, *columns).where(
        condition, Run.state == JobState.SUCCEEDED, Run.deleted_at.is_(None)
    )
    return [
        OutcomeRow(job, run, fit, validated, dict(zip(parts, values, strict=True)))
        for job, run, fit, validated, *values in session.execute(query)
    ]


def read_parameters(session: Session, runs: Collection[str]) -> dict[str, list[Any]]:
    """Read the entries ``parameters`` of the results of these runs, and nothing else of them."""
    parameters = Run.result.expression["parameters"]
    query = select(Run.id, parameters).where(Run.id.in_(runs), Run.deleted_at.is_(None))
    return {run: entries or [] for run, entries in session.execute(query)}


def record_best_run(session: Session, job: Job) -> None:
    """Take RMS and fit of a job from the result of its best run.

    Before the end, runs report their fitness only. The runs of a batch see different recordings, so
    it has no fit. Without any result, the RMS stays.
    """
    columns = Run.best_rms, Run.fit_estimation, Run.cell
    best = session.execute(select_best_run(job.id).with_only_columns(*columns)).first()
    if best is None:
        job.fit_estimation = None
        return
    is_of_batch = any(path.startswith(DATASETS_PATH) for path in best.cell)
    job.best_rms, job.fit_estimation = best.best_rms, None if is_of_batch else best.fit_estimation


def select_best_run(job: str) -> Select[str]:
    """Select the run of a job with the smallest RMS."""
    query = select(Run.id).where(
        Run.job_id == job, Run.best_rms.is_not(None), Run.deleted_at.is_(None)
    )
    return query.order_by(Run.best_rms, Run.number).limit(1)
