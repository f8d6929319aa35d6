"""Routes of jobs."""

from typing import Annotated

from fastapi import APIRouter, Header, Query, Response, status

from service.api.content import CsvResponse
from service.api.requests.bodies import JsonRoute
from service.api.requests.dependencies import Cursor, Limit, PartsDep, ReadSession, WriteSession
from service.api.routes.item_queries import (
    Cascade,
    IfMatch,
    JobFilterDep,
    Tags,
    delete,
    edit,
    set_etag,
)
from service.core.root_path import to_address
from service.core.states import JobState
from service.items.item_schemas import DeletedOut, EditIn
from service.jobs import submit
from service.jobs.job_schemas import JobIn, JobOut, JobPage
from service.repositories.job_rows import JobRepository
from service.repositories.run_rows import RunOrder
from service.runs import runs
from service.runs.run_schemas import RunPage
from service.storage.clocks import choose_database_clock
from service.sweeps import summary, table
from service.sweeps.sweep_schemas import SummaryOut
from service.trends import batch_trend
from service.trends.trend_schemas import TrendOut
from sysid.trends.trend import OutlierRule

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], route_class=JsonRoute)

IdempotencyKeyHeader = Annotated[
    str | None, Header(max_length=200, description="the same key returns the same job")
]
StatesFilter = Annotated[
    list[JobState] | None, Query(description="lists only jobs or runs in these states")
]
CellFilter = Annotated[
    list[str] | None,
    Query(description="`/noise/sigma=0.1` selects the cells with that value; may be repeated"),
]
RunCursor = Annotated[str | None, Query(max_length=200, description="`next` of the previous page")]
Order = Annotated[RunOrder, Query(description="column to sort by; runs without a value come last")]
Descending = Annotated[bool, Query(description="whether the largest value comes first")]


@router.post("", status_code=status.HTTP_202_ACCEPTED)
def submit_job(
    body: JobIn,
    parts: PartsDep,
    response: Response,
    idempotency_key: IdempotencyKeyHeader = None,
) -> JobOut:
    """Queue a job. The answer reports every fault of the request.

    A sweep of more than 2,000 runs creates the further runs while it runs. Until then they count
    as queued, and have no page and no identifier.
    """
    job = submit.submit_job(parts.database, body, parts.settings, idempotency_key)
    return set_location(job, response)


@router.get("")
def list_jobs(
    session: ReadSession,
    chosen: JobFilterDep,
    cursor: Cursor = None,
    limit: Limit = 50,
    state: StatesFilter = None,
) -> JobPage:
    """List jobs, latest first; all conditions must hold."""
    return submit.list_jobs(session, cursor, limit, state or [], chosen)


@router.get("/{job_id}")
def read_job(job_id: str, session: ReadSession, response: Response) -> JobOut:
    """Read one job: state, progress, and the exact request."""
    job = JobRepository(session).get(job_id)
    set_etag(response, job)
    return submit.describe_job(session, job)


@router.patch("/{job_id}")
def edit_job(
    job_id: str,
    body: EditIn,
    session: WriteSession,
    response: Response,
    if_match: IfMatch = None,
) -> JobOut:
    """Change name, note or tags of a job; with `If-Match` only if they are as they were read."""
    edit(session, "job", job_id, body, if_match, response)
    job = JobRepository(session).get(job_id)
    return submit.describe_job(session, job)


@router.delete("/{job_id}")
def delete_job(
    job_id: str, session: WriteSession, cascade: Cascade = False, if_match: IfMatch = None
) -> DeletedOut:
    """Delete an ended job with its runs; 409 lists what was made from them."""
    return delete(session, "job", job_id, cascade, if_match)


@router.post("/{job_id}:cancel")
def cancel_job(job_id: str, session: WriteSession) -> JobOut:
    """Cancel a job: immediately if it is queued, within moments if it runs."""
    job = JobRepository(session).cancel(job_id)
    return submit.to_job_out(job, choose_database_clock(session))


@router.post("/{job_id}:resume", status_code=status.HTTP_202_ACCEPTED)
def resume_job(
    job_id: str,
    parts: PartsDep,
    session: WriteSession,
    response: Response,
    failed: Annotated[
        bool, Query(description="only the failed runs, also of a job that has succeeded")
    ] = False,
) -> JobOut:
    """Queue a failed or cancelled job again; it continues from its last checkpoints."""
    job = submit.resume_job(session, job_id, parts.settings, only_failed=failed)
    return set_location(submit.to_job_out(job, choose_database_clock(session)), response)


@router.post("/{job_id}:clone", status_code=status.HTTP_202_ACCEPTED)
def clone_job(job_id: str, parts: PartsDep, response: Response) -> JobOut:
    """Queue the same request as a new job."""
    return set_location(submit.clone_job(parts.database, job_id, parts.settings), response)


@router.get("/{job_id}/runs.csv", response_class=CsvResponse)
def export_runs_csv(job_id: str, parts: PartsDep) -> CsvResponse:
    """Export all runs of a job as CSV: a row per run, with cell, estimates and standard errors."""
    disposition = {"Content-Disposition": f'attachment; filename="{job_id}.csv"'}
    rows = table.stream_table(parts.database, job_id)
    return CsvResponse(rows, headers=disposition)


@router.get("/{job_id}/runs")
def list_runs(
    job_id: str,
    session: ReadSession,
    cursor: RunCursor = None,
    limit: Limit = 50,
    state: StatesFilter = None,
    cell: CellFilter = None,
    label: CellFilter = None,
    tag: Tags = None,
    order: Order = "number",
    descending: Descending = False,
) -> RunPage:
    """List the runs of a job that exist already; filter by axis values, labels or state."""
    choice = runs.RunQuery(state or [], cell or [], label or [], tag or [], order, descending)
    return runs.list_runs(session, job_id, cursor, limit, choice)


@router.get("/{job_id}/summary")
def read_summary(
    job_id: str,
    session: ReadSession,
    by: Annotated[
        list[str] | None,
        Query(
            description="axis (`/noise/sigma`) or label; may be repeated; default: all but seeds"
        ),
    ] = None,
) -> SummaryOut:
    """Summarise the runs for each value of the chosen axes: quantiles, success, evaluations."""
    return summary.summarise_job(session, job_id, by)


@router.get("/{job_id}/trend")
def read_trend(
    job_id: str,
    session: ReadSession,
    outliers: Annotated[
        OutlierRule, Query(description="whether the laws leave outliers out or count them")
    ] = "exclude",
) -> TrendOut:
    """Fit the estimates over a label: law, band, predictions, outliers and drift."""
    return batch_trend.compute_trend(session, job_id, outliers)


def set_location(job: JobOut, response: Response) -> JobOut:
    """Name the address of a new job in the head of its answer."""
    response.headers["Location"] = to_address(f"/v1/jobs/{job.id}")
    return job
