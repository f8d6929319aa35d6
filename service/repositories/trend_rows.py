"""Read the parts of run results that a trend needs."""

from typing import NamedTuple

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.repositories.run_rows import filter_job
from service.storage.columns import Document
from service.storage.sessions import find_project
from service.storage.tables import Run
from sysid.core.findings import Finding
from sysid.core.value_documents import decode, list_fields
from sysid.residuals.onset_delay import OnsetDelay
from sysid.results.result import Agreements, Result
from sysid.uncertainty.estimates import Estimate

_RESULT_PARTS = {
    field.name: field.hint
    for field in list_fields(Result)
    if field.name
    in ("parameters", "onset_delays", "agreement", "findings", "warnings", "noise_model")
}


class TrendRow(NamedTuple):
    """One successful run."""

    id: str
    number: int
    cell: Document
    labels: Document
    evaluations: int
    best_rms: float | None
    parameters: tuple[Estimate, ...]
    onset_delays: tuple[OnsetDelay, ...]
    agreement: Agreements
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]
    noise_model: str


def read_trend_rows(
    session: Session, job_id: str, limit: int, project_id: str | None = None
) -> list[TrendRow]:
    """Read the successful runs of a job in the order of the sweep, at most `limit` of them."""
    names = TrendRow._fields
    columns = [
        Run.result.expression[name] if name in _RESULT_PARTS else getattr(Run, name)
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
    return [
        TrendRow(
            *(
                decode(_RESULT_PARTS[name], value) if name in _RESULT_PARTS else value
                for name, value in zip(names, row, strict=True)
            )
        )
        for row in session.execute(query)
    ]
