"""The report of a job of many runs: what they have in common, and the few that stand out.

Its figures are drawings and it runs no script, so that it stays small. All else is where it came
from: every run as CSV and JSON at the service.
"""

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from markupsafe import Markup
from sqlalchemy.orm import Session

from service.schemas_trends import TrendOut
from service.storage.objects import ObjectStore
from service.storage.runs import RunRepository
from service.storage.tables import Job, Run, State
from service.web import figures, figures_signals
from service.web.cells import GridView, grid_of
from service.web.drawn import drawing, is_drawable
from service.web.figures import Figure
from service.web.figures_trend import trend_figure
from service.web.links import dataset_links, unnamed
from service.web.pages import run_in_full, run_summary
from service.web.reading import evidence_of, unit_of
from service.web.rendering import render
from service.web.report_parts import style
from service.web.results import FigureChoice, job_figure
from service.web.signals import experiments_of
from service.web.trend_view import trend_view
from service.web.views import RunView, job_view

STANDING_OUT = 10
FAILED_SHOWN = 20
ROWS_SHOWN = 60
"""Rows of the grid of cells that a report shows."""
POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


@dataclass(frozen=True, slots=True)
class _Section:
    """One run in full: why it is shown, and its drawings."""

    why: str
    run: RunView
    drawings: list[tuple[str, Markup]]


def large_report(
    session: Session, store: ObjectStore, job: Job, trend: TrendOut | None, made: datetime,
    base_url: str,
) -> str:  # fmt: skip
    """The report of a job of more runs than a page lists.

    Parameters
    ----------
    base_url : str
        Of the service, for what the report leaves out.
    """
    view = job_view(job, unit_of(session, job.spec), made)
    best, worst = _ends(session, job, is_batch=view.is_batch)
    failed = RunRepository(session).page(job.id, limit=FAILED_SHOWN, states=[State.FAILED]).items
    grid = grid_of(session, job, {})
    shown = [("The best run", best[:1]), ("The worst run that succeeded", worst[:1])]
    summaries = {
        name: [run_summary(session, job, run) for run in found]
        for name, found in (("best", best), ("worst", worst), ("failed", failed))
    }
    return render(
        "report_large.html", job=view, made=made, **summaries,
        order="fit" if view.is_batch else "RMS", grid=_cut(grid),
        hidden_rows=max(len(grid.rows) - ROWS_SHOWN, 0) if grid else 0,
        trend=None if trend is None else trend_view(trend),
        drawings=_overview(session, job, trend),
        sections=[_section(session, store, job, why, run) for why, runs in shown for run in runs],
        datasets=dataset_links(session, job), more_datasets=unnamed(job),
        address=f"{base_url.rstrip('/')}/v1/jobs/{job.id}", policy=POLICY, style=style(),
    )  # fmt: skip


def _ends(session: Session, job: Job, *, is_batch: bool) -> tuple[list[Run], list[Run]]:
    """The best and the worst runs that succeeded; of a batch by fit: RMS do not compare."""
    runs, only = RunRepository(session), [State.SUCCEEDED]
    by: Any = "fit_estimation" if is_batch else "best_rms"
    best, worst = (
        list(runs.page(job.id, limit=STANDING_OUT, states=only, order=by, descending=down).items)
        for down in (is_batch, not is_batch)
    )
    return best, worst


def _cut(grid: GridView | None) -> GridView | None:
    if grid is None:
        return None
    return GridView(
        grid.quantity, grid.row_names, grid.column_name, grid.columns, grid.rows[:ROWS_SHOWN],
        grid.is_cut,
    )  # fmt: skip


def _overview(session: Session, job: Job, trend: TrendOut | None) -> list[tuple[str, Markup]]:
    """Titles and drawings of the figures of all runs together."""
    found = [("Errors against the noise", job_figure(session, job.id, FigureChoice(columns=2)))]
    if trend is not None:
        found.append((f"Trend over {trend.x}", trend_figure(trend, 2)))
    return _drawn(found)


def _section(session: Session, store: ObjectStore, job: Job, why: str, run: Run) -> _Section:
    evidence = evidence_of(session, job, run)
    made = [("Progress of every island", figures.history(evidence))]
    experiments = experiments_of(session, store, job, run)[:1]
    made += [("Measured against identified", figures_signals.response(one)) for one in experiments]
    made.append(("Convergence of the parameters", figures.convergence(evidence)))
    return _Section(why, run_in_full(session, job, run), _drawn(made))


def _drawn(made: list[tuple[str, Figure]]) -> list[tuple[str, Markup]]:
    return [(title, drawing(figure, title)) for title, figure in made if is_drawable(figure)]
