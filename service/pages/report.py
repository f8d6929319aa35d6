"""A job as one HTML file: it needs no server and no network, and runs no script but its own.

The report of a job of many runs: what they have in common, and the few that stand out.

Its figures are drawings and it runs no script, so that it stays small. All else is where it came
from: every run as CSV and JSON at the service.
"""

import base64
import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from typing import Any

from markupsafe import Markup
from sqlalchemy.orm import Session

from service.datasets.rms_unit import unit_of
from service.figures import plotly as figures
from service.figures import signals as figures_signals
from service.figures.embed import as_json, bare, templates
from service.figures.plotly import Figure
from service.figures.svg import drawing, is_drawable
from service.figures.trend import trend_figure
from service.jobs.stored_run import StoredRun
from service.pages import render as assets
from service.pages.cell_grid import LISTED, GridView, grid_of
from service.pages.dataset_links import dataset_links, unnamed
from service.pages.diagnostics import residual_figure
from service.pages.figure_data import evidence_of, experiments_of
from service.pages.figures import FigureChoice, job_figure
from service.pages.pages import run_in_full, run_summary
from service.pages.render import render, style
from service.pages.trend import trend_of, trend_view
from service.pages.views import RunView, job_view
from service.repositories.jobs import JobRepository
from service.repositories.runs import RunOrder, RunRepository
from service.runs.residuals import residuals_of
from service.storage.objects import ObjectStore
from service.storage.tables import Job, Run, State
from service.trends.schemas import TrendOut

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
        name: [run_summary(session, StoredRun.from_rows(job, run)) for run in found]
        for name, found in (("best", best), ("worst", worst), ("failed", failed))
    }
    return render(
        "report_large.html", job=view, made=made, **summaries,
        order="fit" if view.is_batch else "RMS", grid=_cut(grid),
        hidden_rows=max(len(grid.rows) - ROWS_SHOWN, 0) if grid else 0,
        trend=None if trend is None else trend_view(trend),
        drawings=_overview(session, job, trend),
        sections=[
            _section(session, store, StoredRun.from_rows(job, run), why)
            for why, runs in shown for run in runs
        ],
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


def _section(session: Session, store: ObjectStore, stored: StoredRun, why: str) -> _Section:
    evidence = evidence_of(session, stored)
    made = [("Progress of every island", figures.history(evidence))]
    experiments = experiments_of(session, store, stored)[:1]
    made += [("Measured against identified", figures_signals.response(one)) for one in experiments]
    made.append(("Convergence of the parameters", figures.convergence(evidence)))
    return _Section(why, run_in_full(session, stored), _drawn(made))


def _drawn(made: list[tuple[str, Figure]]) -> list[tuple[str, Markup]]:
    return [(title, drawing(figure, title)) for title, figure in made if is_drawable(figure)]


RUNS_IN_FULL = 6
EXPERIMENTS_SHOWN = 4


def job_report(session: Session, store: ObjectStore, job_id: str, base_url: str = "") -> str:
    """The report of a job: every run in a table, the few best (of a batch first) in full.

    Of a job of more runs than a page lists: what they have in common, and those that stand out.
    """
    job = JobRepository(session).get(job_id)
    made, batch = datetime.now(UTC), trend_of(session, job)
    if job.n_runs > LISTED:
        return large_report(session, store, job, batch, made, base_url)
    view = job_view(job, unit_of(session, job.spec), made)
    runs = RunRepository(session).page(job.id, limit=LISTED).items
    is_in_order = view.is_batch or len(runs) <= RUNS_IN_FULL
    order: RunOrder = "number" if is_in_order else "best_rms"
    chosen = RunRepository(session).page(job.id, limit=RUNS_IN_FULL, order=order).items
    full = [StoredRun.from_rows(job, run) for run in chosen]
    return render(
        "report.html", job=view, made=made,
        runs=[run_summary(session, StoredRun.from_rows(job, run)) for run in runs],
        overview=_full_overview(session, job), trend=None if batch is None else trend_view(batch),
        trend_figure=None if batch is None else as_json(bare(trend_figure(batch))),
        sections=[
            (run_in_full(session, stored), _figures(session, store, stored)) for stored in full
        ],
        datasets=dataset_links(session, job), more_datasets=unnamed(job),
        policy=policy(), style=style(),
        plotly_code=plotly(), draw=draw(),
        templates=templates(),
    )  # fmt: skip


@cache
def policy() -> str:
    """Content security policy: the two scripts of the report by their hashes, nothing from afar."""
    hashes = " ".join(f"'sha256-{_hash(script)}'" for script in (plotly(), draw()))
    return (
        f"default-src 'none'; script-src {hashes}; style-src 'unsafe-inline'; img-src data: blob:"
    )


def _full_overview(session: Session, job: Job) -> list[tuple[str, int, Markup]]:
    """Title, height (px) and Plotly JSON of the figures of all runs together."""
    found = job_figure(session, job.id, FigureChoice(columns=2))
    if not found["data"]:
        return []
    return [("Errors against the noise", found["layout"]["height"], as_json(bare(found)))]


def _figures(
    session: Session, store: ObjectStore, stored: StoredRun
) -> list[tuple[str, int, Markup]]:
    """Title, height (px) and Plotly JSON of a run's figures, those with something to show."""
    evidence = evidence_of(session, stored)
    made = [("Progress of every island", figures.history(evidence))]
    for experiment in experiments_of(session, store, stored)[:EXPERIMENTS_SHOWN]:
        title = f"Measured against identified: {experiment.name}"
        made.append((title, figures_signals.response(experiment)))
    tested = residuals_of(session, store, stored)
    if tested is not None:
        made += [
            (f"Correlation of the residuals: {name}", residual_figure(tested, number))
            for number, name in enumerate(tested.names[:EXPERIMENTS_SHOWN])
        ]
    made += [
        ("Convergence of the parameters", figures.convergence(evidence)),
        ("Correlation of the estimates", figures.correlation(evidence)),
        ("What each island found", figures.waterfall(evidence)),
    ]
    return [
        (title, figure["layout"]["height"], as_json(bare(figure)))
        for title, figure in made
        if any(_has_points(trace) for trace in figure["data"])
    ]


def _has_points(trace: dict[str, Any]) -> bool:
    return len(trace["x"]) > 0


@cache
def plotly() -> Markup:
    """The Plotly bundle as the content of a script element."""
    return _script(assets.plotly_file().read_text(encoding="utf-8"))


@cache
def draw() -> Markup:
    """What draws the figures, as the content of a script element."""
    return _script((assets.STATIC / "report.js").read_text(encoding="utf-8"))


def _script(text: str) -> Markup:
    # In a string or an expression of a script, <\/ means the same and does not end the element.
    return Markup(text.replace("</script", "<\\/script"))


def _hash(script: str) -> str:
    return base64.b64encode(hashlib.sha256(str(script).encode()).digest()).decode()
