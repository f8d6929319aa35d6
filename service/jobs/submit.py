"""Use cases of jobs: submit, read, cancel, resume, clone."""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from itertools import islice
from typing import Any

from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest, QuotaExceeded
from service.core.label_text import name_label
from service.core.settings import Settings
from service.core.states import JobState
from service.datasets.rms_unit import find_rms_unit
from service.jobs.axes import build_axis_groups, count_runs, group_axes
from service.jobs.checks import JobChecker
from service.jobs.job_links import (
    find_model_name,
    list_used_datasets,
    list_used_runs,
    store_job_links,
)
from service.jobs.job_schemas import JobIn, JobOut, JobPage, OutcomeOut, ProgressOut
from service.jobs.outcomes import read_outcomes
from service.jobs.stored_cells import (
    CELLS_AT_SUBMISSION,
    build_stored_cells,
    read_axis_groups,
    resolve_axes,
)
from service.jobs.sweep_checks import find_job_faults
from service.queue.admission import count_unfinished
from service.queue.run_writes import NewRun, insert_runs
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.job_rows import JobRepository, NewJob, Submission
from service.repositories.project_rows import (
    ProjectRepository,
    check_bytes,
    check_daily_evaluations,
)
from service.repositories.run_rows import RunRepository
from service.repositories.search_conditions import NO_FILTER, ListFilter
from service.storage.clocks import Clock, choose_database_clock
from service.storage.sessions import Database
from service.storage.storage_errors import RowNotFound
from service.storage.tables import Dataset, Job


@dataclass(frozen=True, slots=True)
class CheckedJob:
    """Checked job that can be queued: row to store, digest of its body, and its first cells."""

    job: NewJob
    digest: str
    cells: tuple[NewRun, ...]


def submit_job(
    database: Database, body: JobIn, settings: Settings, key: str | None = None
) -> JobOut:
    """Queue a job with its first runs. The dispatcher creates the other runs later.

    SQLite's only write lock is held for the rows only, not during the checks.

    Raises
    ------
    InvalidRequest
        With every fault that can be detected before the job runs.
    KeyReused
        If the idempotency key was used with another body.
    QuotaExceeded
        If the project has too much queued and running, or made too many evaluations today.
    """
    with database.read_session() as session:
        checked = check_job(session, body, settings)
    with database.write_session() as session:
        job = store_job(session, checked, settings, key).job
        return to_job_out(job, choose_database_clock(session))


def check_job(
    session: Session, body: JobIn, settings: Settings, unstored: Iterable[Dataset] = ()
) -> CheckedJob:
    """Check a job and resolve names to identifiers, also in its axes.

    `unstored` are datasets that it may name before they are stored.

    Raises
    ------
    InvalidRequest
        With every fault that can be detected before the job runs.
    """
    document = body.to_normal_form()
    digest = hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
    checker = JobChecker(session, unstored)
    faults = find_job_faults(session, checker, body, settings.max_runs_per_job)
    if faults:
        raise InvalidRequest(faults)
    numbers = group_axes(body.sweep.axes)
    n_runs, groups = count_runs(body, numbers), build_axis_groups(body.sweep.axes, numbers)
    spec = checker.resolve_body(document)
    spec["sweep"] = {"axes": resolve_axes(checker, spec, groups)}
    new = NewJob(
        name=body.name or _choose_name(checker, spec),
        spec=spec,
        n_runs=n_runs,
        priority=body.priority,
        max_attempts=settings.max_attempts,
        version=version("lagid"),
        spec_hash=digest,
    )
    first = islice(build_stored_cells(spec, read_axis_groups(spec)), CELLS_AT_SUBMISSION)
    return CheckedJob(new, digest, tuple(first))


def store_job(
    session: Session, checked: CheckedJob, settings: Settings, key: str | None = None
) -> Submission:
    """Store a checked job and its first runs.

    Raises
    ------
    KeyReused
        If the idempotency key was used with another body.
    QuotaExceeded
        If the project has too much queued and running, or made too many evaluations today.
    """
    submission = JobRepository(session).submit(checked.job, key=key, request_hash=checked.digest)
    if submission.is_new:
        check_limits(session, submission.job, settings)
        _lock_used(session, checked.job.spec)
        insert_runs(session, submission.job, checked.cells)
        store_job_links(session, submission.job)
    return submission


def _lock_used(session: Session, spec: Mapping[str, Any]) -> None:
    """Keep what a job uses from being deleted before the job is stored.

    Raises
    ------
    InvalidRequest
        If something was deleted since the job was checked.
    """
    try:
        DatasetRepository(session).lock_used(list_used_datasets(spec))
        runs = RunRepository(session)
        for run in list_used_runs(spec):
            JobRepository(session).share_lock(runs.get(run).job_id)
            runs.get(run)
    except RowNotFound as error:
        raise InvalidRequest.from_fault("", f"{error} any more; it was just deleted") from None


def check_limits(session: Session, job: Job, settings: Settings) -> None:
    """Refuse a job just queued if its project now exceeds its limits of work.

    Raises
    ------
    QuotaExceeded
        With the counts; the caller's transaction ends with it.
    """
    limits = ProjectRepository(session).lock_limits(job.project_id)
    max_jobs = settings.max_open_jobs if limits.max_open_jobs is None else limits.max_open_jobs
    max_runs = settings.max_open_runs if limits.max_open_runs is None else limits.max_open_runs
    open_now = count_unfinished(session, job.project_id)
    if open_now.jobs > max_jobs:
        raise QuotaExceeded(
            f"{open_now.jobs - 1} jobs of the project are queued or running; at most "
            f"{max_jobs} may be. Cancel some, or submit this job later"
        )
    if open_now.runs > max_runs:
        left = job.n_runs - job.n_done
        raise QuotaExceeded(
            f"{open_now.runs - left} runs of the project are not done, and this job adds {left}. "
            f"At most {max_runs} may be open. Cancel some, or submit this job later"
        )
    check_daily_evaluations(session, job.project_id, limits.max_daily_evaluations)
    check_bytes(session, job.project_id, limits.max_stored_bytes)


def resume_job(
    session: Session, job_id: str, settings: Settings, *, only_failed: bool = False
) -> Job:
    """Queue a failed or cancelled job again; or the failed runs alone of one that has ended.

    Raises
    ------
    Conflict
        If it is in another state.
    QuotaExceeded
        If the project has too much queued and running, or made too many evaluations today.
    """
    job = JobRepository(session).resume(job_id, only_failed=only_failed)
    check_limits(session, job, settings)
    return job


def clone_job(database: Database, job_id: str, settings: Settings) -> JobOut:
    """Queue the same request as a new job. A name that the service chose is chosen again."""
    with database.read_session() as session:
        old = JobRepository(session).get(job_id)
    body = JobIn.model_validate({**old.spec, "name": old.spec["name"] and old.name})
    return submit_job(database, body, settings)


def to_job_out(
    job: Job,
    clock: Clock,
    *,
    with_request: bool = False,
    rms_unit: str | None = None,
    outcome: OutcomeOut | None = None,
) -> JobOut:
    """Build the answer for a job; its start was told by `clock`, that of the database."""
    return JobOut.from_source(
        job,
        tags=job.tags or [],
        model=find_model_name(job.spec),
        progress=ProgressOut.from_source(
            job,
            runs=job.n_runs,
            finished=job.n_done,
            failed=job.n_failed,
            reused=job.n_reused,
        ),
        request=job.spec if with_request else None,
        rms_unit=rms_unit,
        outcome=outcome,
        seconds=measure_seconds(job, clock),
    )


def describe_job(session: Session, job: Job) -> JobOut:
    """Build the whole answer for one job, with its request and outcome."""
    return to_job_out(
        job,
        choose_database_clock(session),
        with_request=True,
        rms_unit=find_rms_unit(session, job.spec),
        outcome=read_outcomes(session, [job]).get(job.id),
    )


def measure_seconds(job: Job, clock: Clock) -> float | None:
    """Return the wall time of a job from its first start to its end or to now; None if queued."""
    if job.state is JobState.QUEUED or job.started_at is None:
        return None
    return max(((job.finished_at or clock()) - job.started_at).total_seconds(), 0.0)


def list_jobs(
    session: Session,
    cursor: str | None,
    limit: int,
    states: Sequence[JobState] = (),
    chosen: ListFilter = NO_FILTER,
) -> JobPage:
    """List the jobs that meet a filter, latest first."""
    page = JobRepository(session).list_page(
        cursor=cursor, limit=limit, states=states, chosen=chosen
    )
    outcomes, clock = read_outcomes(session, page.items), choose_database_clock(session)
    items = [
        to_job_out(
            job, clock, rms_unit=find_rms_unit(session, job.spec), outcome=outcomes.get(job.id)
        )
        for job in page.items
    ]
    return JobPage(items=items, next=page.next)


def _choose_name(checker: JobChecker, spec: Mapping[str, Any]) -> str:
    """Name a job after its model and data, or after the label of its trend."""
    model = find_model_name(spec)
    if spec["trend"]:
        return f"{model} over {name_label(spec['trend']['x'])}"
    data = checker.get_dataset(spec["datasets"][0])
    return f"{model} on {data if isinstance(data, str) else data.name}"
