"""What lists of jobs tell of results: one run stands for each job, and parts of its result."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

from sqlalchemy import ColumnElement, Select, select
from sqlalchemy.orm import Session

from service.core.bodies.job_fields import DATASETS_PATH
from service.core.states import JobState
from service.storage.columns import Document
from service.storage.tables import Job, Run
from sysid.core.value_documents import decode
from sysid.uncertainty.estimates import Estimate


class OutcomeRow(NamedTuple):
    """The only run of a job, or its best one by RMS, with parts of its result."""

    job: str
    run: str
    cell: Document
    labels: Document
    fit_estimation: float | None
    fit_validation: float | None
    parts: Document


def read_outcome_rows(
    session: Session, jobs: Sequence[Job], parts: Sequence[str]
) -> list[OutcomeRow]:
    """Read one row for each of these jobs that has a run with a result."""
    columns = [Run.result.expression[part] for part in parts]
    row = Run.job_id, Run.id, Run.cell, Run.labels, Run.fit_estimation, Run.fit_validation
    query = select(*row, *columns).where(
        match_outcomes(session, jobs), Run.state == JobState.SUCCEEDED, Run.deleted_at.is_(None)
    )
    return [
        OutcomeRow(job, run, cell, labels, fit, validated, dict(zip(parts, values, strict=True)))
        for job, run, cell, labels, fit, validated, *values in session.execute(query)
    ]


def match_outcomes(session: Session, jobs: Sequence[Job]) -> ColumnElement[bool]:
    """Match the run that stands for each of these jobs. No result is read.

    One query finds the best runs of all jobs that have several, each as the first of an index.
    """
    single = [job.id for job in jobs if job.n_runs == 1 and job.n_done]
    several = [job.id for job in jobs if job.n_runs > 1 and job.n_done]
    best_run = _select_best_run(Job.id.expression).scalar_subquery()
    best = session.scalars(select(best_run).where(Job.id.in_(several))) if several else ()
    return (Run.job_id.in_(single) & (Run.number == 0)) | Run.id.in_(list(filter(None, best)))


def read_estimates(session: Session, runs: Collection[str]) -> dict[str, tuple[Estimate, ...]]:
    """Read the estimates of these runs, and nothing else of their results."""
    parameters = Run.result.expression["parameters"]
    query = select(Run.id, parameters).where(Run.id.in_(runs), Run.deleted_at.is_(None))
    return {
        run: decode(tuple[Estimate, ...], entries or []) for run, entries in session.execute(query)
    }


def record_best_run(session: Session, job: Job) -> None:
    """Take RMS, fit and trust of a job from the result of its best run.

    Before the end, runs report their fitness only. The runs of a batch see different recordings, so
    it has neither fit nor trust. Without any result, the RMS stays.
    """
    verdict = Run.result.expression["verdict"]
    columns = Run.best_rms, Run.fit_estimation, Run.cell, verdict["trust"].as_string()
    best = session.execute(_select_best_run(job.id).with_only_columns(*columns)).first()
    job.fit_estimation = job.trust = None
    if best is None:
        return
    job.best_rms, fit, cell, trust = best
    if not any(path.startswith(DATASETS_PATH) for path in cell):
        job.fit_estimation, job.trust = fit, trust


def _select_best_run(job: str | ColumnElement[str]) -> Select[str]:
    """Select the run of a job with the smallest RMS."""
    query = select(Run.id).where(
        Run.job_id == job, Run.best_rms.is_not(None), Run.deleted_at.is_(None)
    )
    return query.order_by(Run.best_rms, Run.number).limit(1)
