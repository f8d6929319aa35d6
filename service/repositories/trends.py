"""Read the parts of run results that a trend needs."""

from typing import NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.repositories.runs import filter_job
from service.storage.columns import Document
from service.storage.sessions import find_project
from service.storage.tables import Run

RESULT_PARTS = ("parameters", "onset_delays", "agreement", "warnings", "correlation_times")


class TrendRow(NamedTuple):
    """One successful run."""

    id: str
    number: int
    cell: Document
    labels: Document
    evaluations: int
    best_rms: float | None
    parameters: list[Document]
    onset_delays: list[Document]
    agreement: Document
    warnings: list[str]
    correlation_times: Document


def read_trend_rows(
    session: Session, job_id: str, limit: int, project_id: str | None = None
) -> list[TrendRow]:
    """Read the successful runs of a job in the order of the sweep, at most `limit` of them."""
    names = TrendRow._fields
    columns = [
        Run.result.expression[name] if name in RESULT_PARTS else getattr(Run, name)
        for name in names
    ]
    query = (
        select(*columns)
        .where(
            *filter_job(job_id, project_id or find_project(session)),
            Run.state == JobState.SUCCEEDED,
        )
        .order_by(Run.number)
        .limit(limit)
    )
    return [TrendRow(*row) for row in session.execute(query)]
