"""Render a job as one HTML file that needs no server and no network.

The report of few runs draws its figures with its own scripts. The report of many runs shows a
summary and the best and worst runs. It has SVG figures and no scripts, so that it stays small. All
runs remain available at the service as CSV and JSON.
"""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from markupsafe import Markup
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.figures.embed import strip_template, templates_json, to_script_json, write_figures
from service.figures.svg import is_drawable, to_svg
from service.figures.trend_figure import plot_trend
from service.jobs.stored_run import StoredRun
from service.pages.cell_grid import MAX_LISTED_RUNS, GridView, build_cell_grid
from service.pages.dataset_links import count_unlisted_datasets, dataset_links
from service.pages.figure_data import StoredRunFigures
from service.pages.job_pages import load_full_run, load_run_row
from service.pages.render import (
    draw_script,
    load_stylesheet,
    plotly_script,
    render_template,
    security_policy,
)
from service.pages.run_figures import FigureChoice, load_noise_figure
from service.pages.trend_views import load_trend, to_trend_view
from service.pages.views import RunView, to_job_view
from service.repositories.job_rows import JobRepository
from service.repositories.run_rows import RunOrder, RunRepository
from service.storage.objects import ObjectStore
from service.storage.tables import Job, Run
from service.trends.trend_schemas import TrendOut
from sysid.figures.plotly import Figure
from sysid.results.figures import TITLES, FigureName, draw_run_figure, list_report_figures

MAX_RANKED_RUNS = 10
MAX_FAILED_RUNS = 20
MAX_GRID_ROWS = 60
"""Most rows of the cell grid in a report."""
STATIC_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


@dataclass(frozen=True, slots=True)
class _ReportSection:
    """One run in full, with the reason why it is shown, and its drawings."""

    reason: str
    run: RunView
    drawings: list[tuple[str, Markup]]


def render_large_report(
    session: Session,
    store: ObjectStore,
    job: Job,
    trend: TrendOut | None,
    created: datetime,
    base_url: str,
) -> str:
    """Render the report of a job with more runs than a page lists.

    Parameters
    ----------
    base_url : str
        Address of the service, for links to all runs.
    """
    view = to_job_view(session, job)
    best, worst = _best_and_worst_runs(session, job, is_batch=view.is_batch)
    failed = (
        RunRepository(session)
        .list_page(job.id, limit=MAX_FAILED_RUNS, states=[JobState.FAILED])
        .items
    )
    grid = build_cell_grid(session, job, {})
    shown = [("The best run", best[:1]), ("The worst run that succeeded", worst[:1])]
    summaries = {
        name: [load_run_row(session, StoredRun.from_rows(job, run)) for run in ranked]
        for name, ranked in (("best", best), ("worst", worst), ("failed", failed))
    }
    return render_template(
        "report_large.html",
        job=view,
        made=created,
        **summaries,
        order="fit" if view.is_batch else "RMS",
        grid=_truncate_grid(grid),
        hidden_rows=max(len(grid.rows) - MAX_GRID_ROWS, 0) if grid else 0,
        trend=None if trend is None else to_trend_view(trend),
        drawings=_overview_drawings(session, job, trend),
        sections=[
            _build_section(session, store, StoredRun.from_rows(job, run), why)
            for why, runs in shown
            for run in runs
        ],
        datasets=dataset_links(session, job),
        more_datasets=count_unlisted_datasets(job),
        address=f"{base_url.rstrip('/')}/v1/jobs/{job.id}",
        policy=STATIC_POLICY,
        style=load_stylesheet(),
    )


def _best_and_worst_runs(
    session: Session, job: Job, *, is_batch: bool
) -> tuple[list[Run], list[Run]]:
    """Find the best and worst succeeded runs by RMS, or by fit in a batch (data differ)."""
    runs, only = RunRepository(session), [JobState.SUCCEEDED]
    by: Any = "fit_estimation" if is_batch else "best_rms"
    best, worst = (
        list(
            runs.list_page(
                job.id, limit=MAX_RANKED_RUNS, states=only, order=by, descending=down
            ).items
        )
        for down in (is_batch, not is_batch)
    )
    return best, worst


def _truncate_grid(grid: GridView | None) -> GridView | None:
    if grid is None:
        return None
    return GridView(
        grid.quantity,
        grid.row_names,
        grid.column_name,
        grid.columns,
        grid.rows[:MAX_GRID_ROWS],
        grid.is_cut,
    )


def _overview_drawings(
    session: Session, job: Job, trend: TrendOut | None
) -> list[tuple[str, Markup]]:
    """Draw the figures that cover all runs; each has a title."""
    titled = [
        ("Errors against the noise", load_noise_figure(session, job.id, FigureChoice(columns=2)))
    ]
    if trend is not None:
        titled.append((f"Trend over {trend.x}", plot_trend(trend, 2)))
    return _draw_figures(titled)


def _build_section(
    session: Session, store: ObjectStore, stored: StoredRun, why: str
) -> _ReportSection:
    run = StoredRunFigures(session, store, stored)
    names: tuple[FigureName, ...] = ("history", "response", "convergence")
    titled = [(TITLES[name], draw_run_figure(run, name)) for name in names]
    return _ReportSection(why, load_full_run(session, store, stored), _draw_figures(titled))


def _draw_figures(titled: list[tuple[str, Figure]]) -> list[tuple[str, Markup]]:
    return [(title, to_svg(figure, title)) for title, figure in titled if is_drawable(figure)]


MAX_FULL_RUNS = 6
MAX_EXPERIMENTS = 4


def render_job_report(session: Session, store: ObjectStore, job_id: str, base_url: str = "") -> str:
    """Render the report of a job: every run in a table, the best (of a batch the first) in full.

    If the job has more runs than a page lists, the report summarises them.
    """
    job = JobRepository(session).get(job_id)
    created, batch = datetime.now(UTC), load_trend(session, job)
    if job.n_runs > MAX_LISTED_RUNS:
        return render_large_report(session, store, job, batch, created, base_url)
    view = to_job_view(session, job)
    runs = RunRepository(session).list_page(job.id, limit=MAX_LISTED_RUNS).items
    is_in_order = view.is_batch or len(runs) <= MAX_FULL_RUNS
    order: RunOrder = "number" if is_in_order else "best_rms"
    chosen = RunRepository(session).list_page(job.id, limit=MAX_FULL_RUNS, order=order).items
    full = [StoredRun.from_rows(job, run) for run in chosen]
    return render_template(
        "report.html",
        job=view,
        made=created,
        runs=[load_run_row(session, StoredRun.from_rows(job, run)) for run in runs],
        overview=_overview_figures(session, job),
        trend=None if batch is None else to_trend_view(batch),
        trend_figure=None if batch is None else to_script_json(strip_template(plot_trend(batch))),
        sections=[
            (load_full_run(session, store, stored), _run_figures(session, store, stored))
            for stored in full
        ],
        datasets=dataset_links(session, job),
        more_datasets=count_unlisted_datasets(job),
        policy=security_policy(),
        style=load_stylesheet(),
        plotly_code=plotly_script(),
        draw=draw_script(),
        templates=templates_json(),
    )


def _overview_figures(session: Session, job: Job) -> list[tuple[str, int, Markup]]:
    """Title, height (px) and Plotly JSON of the figures that cover all runs."""
    figure = load_noise_figure(session, job.id, FigureChoice(columns=2))
    if not figure["data"]:
        return []
    return [
        (
            "Errors against the noise",
            figure["layout"]["height"],
            to_script_json(strip_template(figure)),
        )
    ]


def _run_figures(
    session: Session, store: ObjectStore, stored: StoredRun
) -> list[tuple[str, int, Markup]]:
    """Title, height (px) and Plotly JSON of a run's figures that have data."""
    run = StoredRunFigures(session, store, stored)
    return write_figures(list_report_figures(run, MAX_EXPERIMENTS, names_each=True))
