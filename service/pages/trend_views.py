"""Views of a trend for pages and reports: tables of texts."""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple

from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest
from service.figures.trend_figure import trend_height
from service.storage.tables import Job
from service.trends.batch_trend import compute_trend, has_trend
from service.trends.trend_schemas import TrendOut
from service.trends.trend_text import (
    TYPESET,
    PlaceRow,
    PredictionRow,
    build_tables,
    format_reference,
    list_notes,
)
from sysid.core.text import format_number
from sysid.trends.trend import OutlierRule


@dataclass(frozen=True, slots=True)
class TrendView:
    """View of a trend; `laws` are (text, AIC, Birge ratio, whether chosen).

    The form suggests to accept the run at the reference's label under its name. In a batch without
    a reference it suggests the middle run without an outlier, which is the nearest to all others.
    """

    x: str
    outliers: OutlierRule
    has_outliers: bool
    headings: Sequence[str]
    rows: Sequence[PlaceRow]
    laws: Sequence[tuple[str, str, str, bool]]
    predictions: Sequence[PredictionRow]
    reasons: Sequence[str]
    notes: Sequence[str]
    reference: str | None
    reference_text: str
    suggested_run: str
    suggested_name: str
    height: int


def load_trend(session: Session, job: Job, outliers: OutlierRule = "exclude") -> TrendOut | None:
    """Load the trend of a job; None if it requests none, or has too many runs for one."""
    if not has_trend(job):
        return None
    try:
        return compute_trend(session, job.id, outliers)
    except InvalidRequest:
        return None


MAX_FLAGGED_RUNS = 100
"""The flags of a batch with more runs are shown on its own page only."""
FLAG_SECONDS = 0.15
"""Time for the flags of a list. Batches that come later have theirs in the next view."""


class FlagCount(NamedTuple):
    """What is told of a batch: flags need attention, other notes do not."""

    flags: int
    notes: int


def count_trend_flags(session: Session, jobs: Sequence[Job]) -> dict[str, FlagCount]:
    """Count what is told of each batch that has ended, by the job."""
    counts: dict[str, FlagCount] = {}
    started = perf_counter()
    for job in jobs:
        if not job.state.is_terminal or not job.n_done or job.n_runs > MAX_FLAGGED_RUNS:
            continue
        trend = load_trend(session, job)
        if trend is not None:
            tables = build_tables(trend.model_dump(), TYPESET)
            told = {text for label in trend.labels for text in label.warnings}
            counts[job.id] = FlagCount(sum(len(row.flags) for row in tables.rows), len(told))
        if perf_counter() - started > FLAG_SECONDS:
            break
    return counts


def to_trend_view(trend: TrendOut) -> TrendView:
    """Build the view of a trend."""
    document = trend.model_dump()
    tables = build_tables(document, TYPESET)
    return TrendView(
        x=trend.x,
        outliers=trend.outliers,
        has_outliers=any(p.is_outlier for quantity in trend.quantities for p in quantity.points),
        headings=tables.headings,
        rows=tables.rows,
        laws=[
            (law.text, format_number(law.aic), format_number(law.birge, 3), law.is_chosen)
            for law in tables.laws
        ],
        predictions=tables.predictions,
        reasons=[f"{name}: {reason}" for name, reason in tables.reasons],
        notes=list_notes(document),
        reference=trend.reference,
        reference_text=format_reference(document),
        suggested_run=_suggest_run(trend),
        suggested_name=next(iter(trend.reference_names), ""),
        height=trend_height(trend),
    )


def _suggest_run(trend: TrendOut) -> str:
    runs = {point.x: point.runs[0] for point in trend.labels if point.runs}
    outliers = {p.x for quantity in trend.quantities for p in quantity.points if p.is_outlier}
    usual = [run for x, run in runs.items() if x not in outliers]
    middle = usual[len(usual) // 2 : len(usual) // 2 + 1]
    at_reference = None if trend.reference_x is None else runs.get(trend.reference_x)
    return at_reference or next(iter(middle), "")
