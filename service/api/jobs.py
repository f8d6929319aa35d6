"""Routes of jobs."""

from typing import Annotated

from fastapi import APIRouter, Header, Query, Response, status
from fastapi.responses import StreamingResponse

from service.api.dependencies import Cursor, Limit, PartsDep, ReadSession, WriteSession
from service.core.wire import Page
from service.datasets.rms_unit import unit_of
from service.jobs import submit as jobs
from service.jobs.schemas import JobIn, JobOut
from service.repositories.jobs import JobRepository
from service.repositories.runs import RunOrder
from service.runs import runs
from service.runs import table as runs_table
from service.runs.schemas import RunOut
from service.storage.tables import State
from service.sweeps import summary as summaries
from service.sweeps.schemas import SummaryOut
from service.trends import trend as trends
from service.trends.schemas import TrendOut

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

Key = Annotated[str | None, Header(max_length=200, description="same key, same job")]
States = Annotated[list[State] | None, Query(description="only jobs or runs in these states")]
Filter = Annotated[
    list[str] | None,
    Query(description="`/noise/sigma=0.1` keeps the cells with that value; may be repeated"),
]


@router.post("", status_code=status.HTTP_202_ACCEPTED)
def submit(
    body: JobIn,
    parts: PartsDep,
    response: Response,
    idempotency_key: Key = None,
) -> JobOut:
    """Queue a job. Everything that can be wrong with it is told now.

    Of a sweep of more than 2,000 runs the others are made while it runs; until then they count as
    queued, and have no page and no identifier.
    """
    job = jobs.submit_to(parts.database, body, parts.settings, idempotency_key)
    return _accepted(job, response)


@router.get("")
def page(
    session: ReadSession, cursor: Cursor = None, limit: Limit = 50, state: States = None
) -> Page[JobOut]:
    """Jobs, latest first."""
    return jobs.page(session, cursor, limit, state or [])


@router.get("/{job_id}")
def read(job_id: str, session: ReadSession) -> JobOut:
    """One job: state, progress, and the exact request."""
    job = JobRepository(session).get(job_id)
    return jobs.told(job, with_request=True, rms_unit=unit_of(session, job.spec))


@router.post("/{job_id}:cancel")
def cancel(job_id: str, session: WriteSession) -> JobOut:
    """Cancel a job: at once if it is queued, within a moment if it runs."""
    return jobs.told(JobRepository(session).cancel(job_id))


@router.post("/{job_id}:resume", status_code=status.HTTP_202_ACCEPTED)
def resume(job_id: str, parts: PartsDep, session: WriteSession, response: Response) -> JobOut:
    """Queue a failed or cancelled job again; it goes on from its last checkpoints."""
    return _accepted(jobs.told(jobs.resume(session, job_id, parts.settings)), response)


@router.post("/{job_id}:clone", status_code=status.HTTP_202_ACCEPTED)
def clone(job_id: str, parts: PartsDep, response: Response) -> JobOut:
    """Queue the same request as a new job."""
    return _accepted(jobs.clone(parts.database, job_id, parts.settings), response)


@router.get("/{job_id}/runs.csv", response_class=StreamingResponse)
def table_of_runs(job_id: str, parts: PartsDep) -> StreamingResponse:
    """All runs of a job as CSV: one row each, with its cell, its estimates and their errors."""
    disposition = {"Content-Disposition": f'attachment; filename="{job_id}.csv"'}
    rows = runs_table.table(parts.database, job_id)
    return StreamingResponse(rows, media_type="text/csv", headers=disposition)


@router.get("/{job_id}/runs")
def runs_of(
    job_id: str,
    session: ReadSession,
    cursor: Annotated[str | None, Query(max_length=200)] = None,
    limit: Limit = 50,
    state: States = None,
    cell: Filter = None,
    label: Filter = None,
    order: RunOrder = "number",
    descending: bool = False,
) -> Page[RunOut]:
    """Runs of a job that have been made; filter by axis values, labels or state."""
    choice = runs.Choice(state or [], cell or [], label or [], order, descending)
    return runs.page(session, job_id, cursor, limit, choice)


@router.get("/{job_id}/summary")
def summary(
    job_id: str,
    session: ReadSession,
    by: Annotated[
        list[str] | None,
        Query(description="axis (`/noise/sigma`) or label; may be repeated; default: no seeds"),
    ] = None,
) -> SummaryOut:
    """Quantiles, success rate and mean evaluations for each value of the chosen axes."""
    return summaries.summary(session, job_id, by)


@router.get("/{job_id}/trend")
def trend(job_id: str, session: ReadSession) -> TrendOut:
    """Estimates over a label: the law, its band, predictions, outliers and drift."""
    return trends.trend(session, job_id)


def _accepted(job: JobOut, response: Response) -> JobOut:
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job
