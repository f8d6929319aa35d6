"""A job as one HTML file: it needs no server and no network, and runs no script but its own."""

import base64
import hashlib
from datetime import UTC, datetime
from functools import cache
from typing import Any

from markupsafe import Markup
from sqlalchemy.orm import Session

from service.residuals import residuals_of
from service.storage.jobs import JobRepository
from service.storage.objects import ObjectStore
from service.storage.runs import RunOrder, RunRepository
from service.storage.tables import Job, Run
from service.web import assets, figures, figures_signals
from service.web.cells import LISTED
from service.web.embedding import as_json, bare, templates
from service.web.figures_trend import trend_figure
from service.web.findings import residual_figure
from service.web.links import dataset_links, unnamed
from service.web.pages import run_in_full, run_summary
from service.web.reading import evidence_of, unit_of
from service.web.rendering import render
from service.web.report_large import large_report
from service.web.report_parts import style
from service.web.results import FigureChoice, job_figure
from service.web.signals import experiments_of
from service.web.trend_view import trend_of, trend_view
from service.web.views import job_view

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
    return render(
        "report.html", job=view, made=made,
        runs=[run_summary(session, job, run) for run in runs], overview=_overview(session, job),
        trend=None if batch is None else trend_view(batch),
        trend_figure=None if batch is None else as_json(bare(trend_figure(batch))),
        sections=[
            (run_in_full(session, job, run), _figures(session, store, job, run)) for run in chosen
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


def _overview(session: Session, job: Job) -> list[tuple[str, int, Markup]]:
    """Title, height (px) and Plotly JSON of the figures of all runs together."""
    found = job_figure(session, job.id, FigureChoice(columns=2))
    if not found["data"]:
        return []
    return [("Errors against the noise", found["layout"]["height"], as_json(bare(found)))]


def _figures(
    session: Session, store: ObjectStore, job: Job, run: Run
) -> list[tuple[str, int, Markup]]:
    """Title, height (px) and Plotly JSON of a run's figures, those with something to show."""
    evidence = evidence_of(session, job, run)
    made = [("Progress of every island", figures.history(evidence))]
    for experiment in experiments_of(session, store, job, run)[:EXPERIMENTS_SHOWN]:
        title = f"Measured against identified: {experiment.name}"
        made.append((title, figures_signals.response(experiment)))
    tested = residuals_of(session, store, job, run)
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
