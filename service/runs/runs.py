"""Use cases of runs: their pages, results, history and migrations."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import Session

from service.core.bodies.json_pointer import build_run_body
from service.core.errors import InvalidRequest
from service.core.states import JobState
from service.jobs.stored_run import StoredRun, load_run
from service.repositories.job_rows import JobRepository
from service.repositories.lineage_rows import WrittenProgress, read_written_progress
from service.repositories.run_rows import RunOrder, RunRepository
from service.runs.explained import load_explained_result
from service.runs.run_schemas import (
    HistoryOut,
    ImprovementOut,
    MigrantOut,
    MigrationsOut,
    RunOut,
    RunPage,
)
from service.storage.columns import Document
from service.storage.objects import ObjectStore
from service.storage.tables import Job, Run
from sysid.core.value_documents import encode
from sysid.models.parameters import Parameter
from sysid.results.result import Result
from sysid.uncertainty.estimates import Estimate

MAX_OPEN_PROGRESS = 0.99  # of an unfinished run: refinement is still to come


@dataclass(frozen=True, slots=True)
class RunQuery:
    """Filter and order of a list of runs."""

    states: Sequence[JobState] = ()
    cell: Sequence[str] = ()
    labels: Sequence[str] = ()
    tags: Sequence[str] = ()
    order: RunOrder = "number"
    descending: bool = False


def list_runs(
    session: Session, job_id: str, cursor: str | None, limit: int, choice: RunQuery
) -> RunPage:
    """List the runs of a job."""
    job = JobRepository(session).get(job_id)
    page = RunRepository(session).list_page(
        job.id,
        cursor=cursor,
        limit=limit,
        states=choice.states,
        cell=parse_filters("cell", choice.cell),
        labels=parse_filters("label", choice.labels),
        tags=choice.tags,
        order=choice.order,
        descending=choice.descending,
    )
    progress = read_written_progress(session, [run.id for run in page.items if run.result is None])
    items = [to_run_out(run, job, progress.get(run.id), with_samples=False) for run in page.items]
    return RunPage(items=items, next=page.next)


def get_run(session: Session, run_id: str, store: ObjectStore | None = None) -> RunOut:
    """Read one run with its result document; from a `store` its residuals are explained too."""
    stored = load_run(session, run_id)
    run = stored.run
    progress = read_written_progress(session, [run.id]) if run.result is None else {}
    answer = to_run_out(run, stored.job, progress.get(run.id))
    answer = answer.model_copy(update={"rms_unit": stored.rms_unit(session)})
    explained = None if store is None else load_explained_result(session, store, stored)
    if explained is not None and explained is not stored.result:
        answer = answer.model_copy(update=encode(explained, Result))
    if run.result is not None or not run.state.is_terminal:
        return answer
    return answer.model_copy(update={"parameters": _list_best_parameters(session, stored)})


def to_run_out(
    run: Run, job: Job, written: WrittenProgress | None = None, *, with_samples: bool = True
) -> RunOut:
    """Build the answer for a run: its result document, or its progress.

    A list of runs is without the samples of the posterior, which it would repeat for each.
    """
    progress: dict[str, Any] = {
        "rms": run.best_rms,
        "evaluations": run.evaluations,
        "generations": run.generations,
    }
    if written is not None:
        progress = {
            "rms": written.rms,
            "evaluations": written.evaluations,
            "generations": written.generation,
        }
    result = run.result or {}
    return RunOut.model_validate(
        {
            **progress,
            **(result if with_samples else _leave_out_samples(result)),
            "id": run.id,
            "job": run.job_id,
            "number": run.number,
            "cell": run.cell,
            "labels": run.labels,
            "state": run.state.value,
            "progress": _compute_progress(run, job, written),
            "error": run.error,
            "seed": run.seed,
            "spec_hash": run.spec_hash,
            "note": run.note,
            "tags": run.tags or [],
            "created_at": run.created_at,
            "started_at": run.started_at,
            "finished_at": run.finished_at,
            "has_signals": run.state is JobState.SUCCEEDED,
        }
    )


def _leave_out_samples(result: Document) -> Document:
    if not result.get("posterior"):
        return result
    posterior = {name: value for name, value in result["posterior"].items() if name != "samples"}
    return {**result, "posterior": posterior}


def get_history(session: Session, run_id: str) -> HistoryOut:
    """Read the improvements of every island's champion, in order."""
    stored = load_run(session, run_id)
    islands: list[list[ImprovementOut]] = []
    for row in RunRepository(session).read_history(run_id):
        while len(islands) <= row.island:
            islands.append([])
        islands[row.island].append(ImprovementOut.from_source(row))
    return HistoryOut(id=stored.run.id, names=_list_free_names(session, stored), islands=islands)


def get_migrations(session: Session, run_id: str) -> MigrationsOut:
    """Read the migration log."""
    rows = RunRepository(session).read_migrations(run_id)
    return MigrationsOut(id=run_id, migrants=[MigrantOut.from_source(row) for row in rows])


def _list_best_parameters(session: Session, stored: StoredRun) -> list[dict[str, Any]]:
    """List the best parameters of a run that ended without a result; no standard errors."""
    points = RunRepository(session).read_history(stored.run.id)
    if not points:
        return []
    best = min(points, key=lambda point: point.rms)
    reason = f"the run was {stored.run.state.value} before its standard errors were computed"
    return [
        encode(
            Estimate(
                parameter.name,
                parameter.unit,
                value,
                parameter.lower,
                parameter.upper,
                None,
                None,
                "unfinished",
                reason,
            )
        )
        for parameter, value in zip(
            _list_free_parameters(session, stored), best.parameters, strict=False
        )
    ]


def _list_free_names(session: Session, stored: StoredRun) -> list[str]:
    if stored.run.result is not None:
        return [estimate.name for estimate in stored.estimates if estimate.is_free]
    return [parameter.name for parameter in _list_free_parameters(session, stored)]


def _list_free_parameters(session: Session, stored: StoredRun) -> list[Parameter]:
    """List the free parameters of a run, in the order of its history's columns."""
    if stored.model.rule is not None:  # the result says which candidates are estimated
        return []
    return [parameter for parameter in stored.parameters(session) if parameter.is_free]


def _compute_progress(run: Run, job: Job, written: WrittenProgress | None) -> float:
    if run.state.is_terminal:
        return 1.0
    # A single run's generation is the job's. The history is behind if nothing improves.
    of_job = job.generation if job.n_runs == 1 else 0
    reached_so_far = max(of_job, written.generation if written is not None else 0)
    generations: int = build_run_body(job.spec, run.cell)["algorithm"]["generations"]
    return min(reached_so_far / generations, MAX_OPEN_PROGRESS)


def parse_filters(name: str, filters: Sequence[str]) -> Mapping[str, Any]:
    """Parse filters of the form ``key=value``; a value that is not JSON is a text.

    Raises
    ------
    InvalidRequest
        If one is not of that form; `name` is the name of the query's field.
    """
    conditions: dict[str, Any] = {}
    for text in filters:
        key, equals, value = text.partition("=")
        if not equals:
            raise InvalidRequest.from_fault(f"?{name}", f"found {text!r}; need path=value")
        try:
            conditions[key] = json.loads(value)
        except (ValueError, RecursionError):
            conditions[key] = value
        if isinstance(conditions[key], int) and abs(conditions[key]) >= 2**63:
            raise InvalidRequest.from_fault(
                f"?{name}", f"found {text!r:.80}; need a number of at most 64 bits"
            )
    return conditions
