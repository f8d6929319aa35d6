"""Use cases of jobs: submit, read, cancel, resume, clone."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import TypeAdapter, ValidationError
from sqlalchemy.orm import Session

from service.checks import JobChecker, value_faults
from service.errors import FieldError, InvalidRequest, TooMuchUnfinished
from service.schemas import Page
from service.schemas_jobs import JobIn, JobOut, Progress, Seed, Sigma
from service.settings import Settings
from service.storage.admission import unfinished
from service.storage.jobs import JobRepository, NewJob, Submission
from service.storage.ledger import Cell as StoredCell
from service.storage.ledger import add_runs
from service.storage.lineage import LineageRepository
from service.storage.tables import Job, State
from service.sweeps import Cell, Step, body_of, count, expand, groups_of, steps_of, value_at
from service.trend_checks import trend_faults

# Fields that no other field depends on: their values are checked alone, a whole body for each of
# a hundred thousand seeds would only take time.
ALONE: Mapping[str, TypeAdapter[Any]] = {
    "/seed": TypeAdapter(Seed),
    "/noise/seed": TypeAdapter(Seed),
    "/noise/sigma": TypeAdapter(Sigma),
}


def submit(session: Session, body: JobIn, settings: Settings, key: str | None = None) -> Submission:
    """Queue a job with all its runs.

    Raises
    ------
    InvalidRequest
        With every fault that can be known before the job runs.
    KeyReused
        If the idempotency key was used with another body.
    """
    document = body.normal_form()
    digest = hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
    axes = groups_of(body)
    n_runs = count(body, axes)
    if n_runs > settings.max_runs_per_job:
        raise InvalidRequest.at(
            "/sweep/axes",
            f"the sweep has {n_runs} runs; at most {settings.max_runs_per_job} a job",
        )
    groups = steps_of(body, axes)
    checker = JobChecker(session)
    _check(checker, document, groups)
    _check_trend(session, checker, body)
    spec = checker.resolved(document)
    new = NewJob(
        name=body.name or _name(checker, spec), spec=spec, n_runs=n_runs, priority=body.priority,
        max_attempts=settings.max_attempts,
    )  # fmt: skip
    submission = JobRepository(session).submit(new, key=key, request_hash=digest)
    if submission.is_new:
        check_limits(session, submission.job, settings)
        cells = (_resolved(checker, spec, cell) for cell in expand(groups))
        add_runs(session, submission.job, _stored(spec, cells))
        lineage = LineageRepository(session)
        lineage.link(submission.job.id, spec["datasets"], "estimation")
        kept = (spec["validation"] or {}).get("datasets") or []
        lineage.link(submission.job.id, kept, "validation")
    return submission


def check_limits(session: Session, job: Job, settings: Settings) -> None:
    """Refuse a job that was just queued if its project now has more unfinished than it may.

    Raises
    ------
    TooMuchUnfinished
        With the counts; the caller's transaction ends with it.
    """
    open_now = unfinished(session, job.project_id)
    if open_now.jobs > settings.max_open_jobs:
        raise TooMuchUnfinished(
            f"{open_now.jobs - 1} jobs of the project wait or run, and at most "
            f"{settings.max_open_jobs} may; submit this one when some have ended, or cancel some"
        )
    if open_now.runs > settings.max_open_runs:
        left = job.n_runs - job.n_done
        raise TooMuchUnfinished(
            f"{open_now.runs - left} runs of the project are not done, and this job has {left} "
            f"more; at most {settings.max_open_runs} may be open; submit it when some have ended, "
            "or cancel some"
        )


def resume(session: Session, job_id: str, settings: Settings) -> Job:
    """Queue a failed or cancelled job again.

    Raises
    ------
    Conflict
        If it is in another state.
    TooMuchUnfinished
        If its project has as much queued and running as it may.
    """
    job = JobRepository(session).resume(job_id)
    check_limits(session, job, settings)
    return job


def clone(session: Session, job_id: str, settings: Settings) -> Job:
    """Queue the same request as a new job."""
    old = JobRepository(session).get(job_id)
    body = JobIn.model_validate({**old.spec, "name": old.name})
    return submit(session, body, settings).job


def told(job: Job, *, with_request: bool = False) -> JobOut:
    """A job as it is told."""
    model = job.spec["model"]
    return JobOut(
        id=job.id, name=job.name, state=job.state.value, cancel_requested=job.cancel_requested,
        created_at=job.created_at, started_at=job.started_at, finished_at=job.finished_at,
        attempt=job.attempt, error=job.error,
        model=model["name"] if isinstance(model, Mapping) else model, priority=job.priority,
        progress=Progress(
            runs=job.n_runs, finished=job.n_done, failed=job.n_failed, reused=job.n_reused,
            best_rms=job.best_rms, evaluations=job.evaluations, generation=job.generation,
            seconds_left=job.seconds_left,
        ),
        request=job.spec if with_request else None,
    )  # fmt: skip


def page(session: Session, cursor: str | None, limit: int, states: list[State]) -> Page[JobOut]:
    """Jobs, latest first."""
    found = JobRepository(session).page(cursor=cursor, limit=limit, states=states)
    return Page(items=[told(job) for job in found.items], next=found.next)


def _check(checker: JobChecker, document: dict[str, Any], groups: list[list[Step]]) -> None:
    errors = checker.errors(body_of(document, {}))
    if not errors:
        errors = list(_sweep_faults(checker, document, groups))
    if errors:
        unique = dict.fromkeys(errors)
        raise InvalidRequest(unique)


def _check_trend(session: Session, checker: JobChecker, body: JobIn) -> None:
    model = checker.model(body.model)
    errors = list(trend_faults(session, body, None if isinstance(model, list) else model[0]))
    if errors:
        raise InvalidRequest(errors)


def _sweep_faults(
    checker: JobChecker, document: dict[str, Any], groups: list[list[Step]]
) -> Iterator[FieldError]:
    """Faults of the values; of a range or a logarithmic axis, those of its first bad value."""
    told: set[str] = set()
    for step in (step for group in groups for step in group):
        if step.pointer in told or _is_good_alone(step.cell):
            continue
        found = list(_step_faults(checker, document, step))
        if found:
            told.add(step.pointer)
        yield from found


def _of_another_type(step: Step, whole: dict[str, Any]) -> Iterator[FieldError]:
    """Values that a body would take for others, as '3' for 3: workers take a cell's as they are."""
    for path, value in step.cell.values.items():
        if not isinstance(value, str | bool | float):
            continue
        taken = value_at(whole, path)
        if not isinstance(taken, type(value) | list):
            yield FieldError(step.pointer, f"{path}: found {value!r}; write {taken!r}")


def _is_good_alone(cell: Cell) -> bool:
    return all(path in ALONE and _fits(ALONE[path], value) for path, value in cell.values.items())


def _fits(kind: TypeAdapter[Any], value: Any) -> bool:
    try:
        kind.validate_python(value, strict=True)
    except ValidationError:
        return False
    return True


def _step_faults(checker: JobChecker, document: dict[str, Any], step: Step) -> Iterator[FieldError]:
    body = body_of(document, step.cell.values)
    wrong = value_faults(step.pointer, body)
    yield from wrong
    if wrong:
        return
    whole = JobIn.model_validate(body).normal_form()
    yield from _of_another_type(step, whole)
    for fault in checker.errors(whole):
        yield FieldError(step.pointer, str(fault), fault.column)


def _resolved(checker: JobChecker, spec: Mapping[str, Any], cell: Cell) -> Cell:
    """The cell with own models as documents, datasets as identifiers, objects with defaults."""
    values = dict(cell.values)
    objects = [path for path, value in values.items() if isinstance(value, dict)]
    if objects:
        whole = JobIn.model_validate(body_of(spec, values)).normal_form()
        values.update({path: value_at(whole, path) for path in objects})
    if "/model" in values:
        model = checker.model(values["/model"])
        values["/model"] = model[1] if isinstance(model, tuple) else values["/model"]
    if "/datasets" in values:
        named = values["/datasets"]
        values["/datasets"] = checker.identifiers([named] if isinstance(named, str) else named)
    if "/warm_start" in values:
        values["/warm_start"] = checker.warm_start(values["/warm_start"])
    return Cell(values, cell.labels)


def _stored(spec: Mapping[str, Any], cells: Iterator[Cell]) -> Iterator[StoredCell]:
    for number, cell in enumerate(cells):
        yield StoredCell(
            number=number, cell=dict(cell.values), labels=dict(cell.labels),
            method=_field(spec, cell, "algorithm", "method"),
            seed=_field(spec, cell, "seed"),
            sigma=_field(spec, cell, "noise", "sigma"),
        )  # fmt: skip


def _field(spec: Mapping[str, Any], cell: Cell, *parts: str) -> Any:
    """A field of the run's body, found without making the body."""
    path = "/" + "/".join(parts)
    if path in cell.values:
        return cell.values[path]
    whole = cell.values.get(f"/{parts[0]}", spec[parts[0]])
    return whole.get(parts[1], spec[parts[0]][parts[1]]) if len(parts) > 1 else whole


def _name(checker: JobChecker, spec: Mapping[str, Any]) -> str:
    model = spec["model"]["name"] if isinstance(spec["model"], Mapping) else spec["model"]
    data = checker.dataset(spec["datasets"][0])
    return f"{model} on {data if isinstance(data, str) else data.name}"
