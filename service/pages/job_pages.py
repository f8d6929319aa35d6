"""Render the pages: jobs, runs, datasets, comparisons, and the forms of recipes."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pprint import pformat
from typing import Any
from urllib.parse import urlencode

from sqlalchemy.orm import Session

from service.core.states import JobState
from service.figures.noise_figure import noise_group_keys, noise_sweep_height
from service.formats.file_kinds import SUFFIXES
from service.items.items import compute_etag
from service.jobs.outcomes import read_outcomes
from service.jobs.stored_run import StoredRun, load_run
from service.models import models
from service.models.model_schemas import ModelOut
from service.pages.cell_grid import build_cell_grid
from service.pages.dataset_links import count_unlisted_datasets, dataset_links
from service.pages.differences import list_differences
from service.pages.documentation.guides import read_guide
from service.pages.figure_data import list_free_parameters
from service.pages.forms.choices import DEFAULTS, list_choices
from service.pages.lineage_drawing import draw_lineage
from service.pages.render import render_template
from service.pages.trend_views import TrendView, count_trend_flags, load_trend, to_trend_view
from service.pages.views import (
    JobView,
    RunView,
    format_cell,
    to_event_view,
    to_job_view,
    to_run_view,
)
from service.queue.dispatchers import DispatcherRepository
from service.repositories.dataset_rows import DatasetRepository
from service.repositories.event_rows import EventRepository
from service.repositories.job_rows import JobOrder, JobRepository
from service.repositories.lineage_rows import describe_items
from service.repositories.reference_rows import ReferenceRepository
from service.repositories.run_rows import RunRepository
from service.repositories.search_conditions import NO_FILTER, ListFilter
from service.runs.comparison import compare_runs, have_same_data
from service.runs.explained import load_explained_result
from service.runs.runs import parse_filters
from service.storage.objects import ObjectStore
from service.storage.tables import Dataset, Job, Run
from service.sweeps.sweep_schemas import NoiseSweepIn
from sysid.core.settings import SEARCH_METHODS
from sysid.core.text import join_estimate
from sysid.data.holds import HOLD_TEXTS
from sysid.figures import signal_figures
from sysid.figures.plotly import WATERFALL_HEIGHT, convergence_height, correlation_height
from sysid.figures.posterior_figures import posterior_height
from sysid.figures.residual_figures import residuals_height
from sysid.results.result import Result
from sysid.trends.trend import OutlierRule

DATASET_ID = re.compile(r"\bds_[0-9a-z]{26}\b")
JOBS_PER_PAGE = 50
RUNS_PER_PAGE = 100
EVENTS_SHOWN = 100
MAX_COMPARED_RUNS = 50


def reference_page() -> str:
    """Render the documentation of the REST interface; a script fills it from /openapi.json."""
    return render_template("reference.html")


def guide_page(path: str) -> str:
    """Render a page of the documentation.

    Raises
    ------
    NotFound
        If there is none.
    """
    return render_template("guide.html", guide=read_guide(path))


DATASET_FILTER_FIELDS = (
    ("name", "Name", "part of it"),
    ("tag", "Tag", ""),
    ("label", "Label", "length_m=5"),
    ("since", "Since", ""),
    ("until", "Until", ""),
)
JOB_FILTER_FIELDS = (
    DATASET_FILTER_FIELDS[0],
    ("model", "Model", ""),
    ("recording", "Recording", "id or name"),
    *DATASET_FILTER_FIELDS[1:],
    ("state", "State", ""),
    ("sort", "Sort by", ""),
)
"""Fields of the filter of a list: name, label and hint."""
JOB_FILTER_CHOICES: Mapping[str, Sequence[tuple[str, str]]] = {
    "state": [("", "any"), *((one.value, one.value) for one in JobState)],
    "sort": [
        ("", "newest first"),
        ("oldest", "oldest first"),
        ("name", "name"),
        ("verdict", "best verdict first"),
        ("worst-verdict", "worst verdict first"),
        ("fit", "best fit first"),
        ("worst-fit", "worst fit first"),
        ("rms", "smallest RMS first"),
    ],
}
"""Values and texts of the fields that are chosen from a list."""
JOB_HEADINGS: Sequence[tuple[str, str, Sequence[tuple[JobOrder, str]]]] = (
    ("State", "", ()),
    ("Job", "", (("name", "ascending"),)),
    ("Result", "", (("verdict", "descending"), ("worst-verdict", "ascending"))),
    ("Fit", "n", (("fit", "descending"), ("worst-fit", "ascending"))),
    ("RMS", "n", (("rms", "ascending"),)),
    ("Findings", "n", ()),
    ("Took", "n", ()),
    ("Age", "n", (("newest", "ascending"), ("oldest", "descending"))),
)
"""Columns of the list of jobs: text, class, and the orders that a click on it goes through."""


@dataclass(frozen=True, slots=True)
class JobSelection:
    """Which jobs a list shows, and in which order; `form` has the same as the user typed it."""

    chosen: ListFilter = NO_FILTER
    states: Sequence[JobState] = ()
    order: JobOrder = "newest"
    form: Mapping[str, str] = field(default_factory=dict)


def jobs_page(session: Session, selection: JobSelection, cursor: str | None, base_url: str) -> str:
    """Render the list of jobs and the form of a new identification.

    Parameters
    ----------
    base_url : str
        Address of the service, for the first steps of a new user.
    """
    page = JobRepository(session).list_page(
        cursor=cursor,
        limit=JOBS_PER_PAGE,
        states=selection.states,
        chosen=selection.chosen,
        order=selection.order,
    )
    outcomes = read_outcomes(session, page.items)
    jobs = [to_job_view(session, job, outcomes.get(job.id)) for job in page.items]
    typed = dict(selection.form)
    stateless = {name: text for name, text in typed.items() if name != "state"}
    return render_template(
        "jobs.html",
        jobs=jobs,
        flags=count_trend_flags(session, page.items),
        state=typed.get("state", ""),
        states=[(one.value, _encode_query({**stateless, "state": one.value})) for one in JobState],
        query_without_state=_encode_query(stateless),
        headings=_link_headings(selection),
        form=typed,
        filter_fields=JOB_FILTER_FIELDS,
        filter_choices=JOB_FILTER_CHOICES,
        any_open=any(job.is_open for job in jobs),
        address=base_url.rstrip("/"),
        cursor=cursor,
        filter_query=_encode_query(typed),
        next=_encode_query({**typed, "cursor": page.next}) if page.next else "",
        choices=list_choices(),
        defaults=DEFAULTS,
        recording_suffixes=",".join(SUFFIXES),
    )


def _link_headings(selection: JobSelection) -> list[dict[str, str]]:
    """Link each heading to the order that a click on it gives; "" where there is none."""
    headings = []
    for text, look, orders in JOB_HEADINGS:
        names = [name for name, _ in orders]
        place = names.index(selection.order) if selection.order in names else -1
        query = {**selection.form, "sort": names[(place + 1) % len(names)]} if names else {}
        headings.append(
            {
                "text": text,
                "look": look,
                "query": _encode_query(query),
                "sorted": orders[place][1] if place >= 0 else "none",
            }
        )
    return headings


def job_page(
    session: Session,
    store: ObjectStore,
    job_id: str,
    base_url: str,
    run_id: str | None = None,
    cursor: str | None = None,
    cell: Sequence[str] = (),
    outliers: OutlierRule = "exclude",
) -> str:
    """Render a job with its runs, one of them in full: the requested, the best, or the first.

    For a large sweep, the page shows the grid of its cells. It lists the runs of the chosen `cell`,
    such as ``/noise/sigma=0.1``. The laws of a trend leave outliers out, or count them.
    """
    job = JobRepository(session).get(job_id)
    runs = RunRepository(session)
    chosen_cell = parse_filters("cell", cell)
    grid = build_cell_grid(session, job, chosen_cell)
    is_listed = grid is None or bool(chosen_cell)
    page = runs.list_page(
        job.id, cursor=cursor, limit=RUNS_PER_PAGE if is_listed else 1, cell=chosen_cell
    )
    chosen = runs.get(run_id) if run_id else _find_best_run(runs, job)
    stored = StoredRun.from_rows(job, chosen) if chosen else None
    view = to_job_view(session, job)
    return render_template(
        "job.html",
        job=view,
        etag=compute_etag(job),
        obstacle=_describe_obstacle(session, job),
        runs=[load_run_row(session, StoredRun.from_rows(job, run)) for run in page.items],
        run=load_full_run(session, store, stored) if stored else None,
        next_runs=_encode_query({"cell": cell, "cursor": page.next}) if page.next else "",
        grid=grid,
        is_listed=is_listed,
        cell_title=format_cell(chosen_cell, {}),
        noise_height=_noise_height(session, job, stored),
        trend=_load_trend_view(session, job, outliers),
        comparable=_comparison_query(page.items),
        datasets=dataset_links(session, job),
        more_datasets=count_unlisted_datasets(job),
        drawing=None if view.is_open else draw_lineage(session, job),
        commands=_request_commands(view, base_url),
        events=[to_event_view(event) for event in _latest_events(session, job)],
    )


def _describe_obstacle(session: Session, job: Job) -> str:
    """Describe why a job cannot begin; empty if nothing is in its way but other jobs."""
    if job.state is not JobState.QUEUED:
        return ""
    wait = DispatcherRepository(session).describe_wait()
    return "" if wait is None else f"This job waits: {wait}."


def compare_page(session: Session, runs: Sequence[str]) -> str:
    """Render a comparison of runs of any jobs; of fewer than two, how to choose them.

    Raises
    ------
    InvalidRequest
        If the runs cannot be compared.
    """
    if len(runs) < 2:
        return render_template("compare.html", comparison=None)
    comparison = compare_runs(session, runs, same_data=False)
    ordered = [load_run(session, run.run) for run in comparison.runs]
    rows = [
        {
            "name": parameter.name,
            "unit": parameter.unit,
            "differs": parameter.differs,
            "texts": [
                _write_estimate(stored, parameter.name, parameter.unit) for stored in ordered
            ],
        }
        for parameter in comparison.parameters
    ]
    first = ordered[0].model
    return render_template(
        "compare.html",
        comparison=comparison,
        same_data=have_same_data(ordered),
        units=[stored.rms_unit(session) for stored in ordered],
        parameters=rows,
        verdicts=[stored.result.verdict for stored in ordered if stored.result is not None],
        differences=_name_datasets(session, [stored.body for stored in ordered]),
        query=urlencode([("run", run) for run in runs]),
        height=signal_figures.response_height(len(first.outputs), len(first.inputs)),
    )


def _write_estimate(stored: StoredRun, name: str, unit: str) -> str:
    """Write the estimate of a parameter; empty if the run has none in this unit."""
    texts = (
        join_estimate(one.value, one.stderr, status=one.status)
        for one in stored.estimates
        if (one.name, one.unit) == (name, unit)
    )
    return next(texts, "")


def _name_datasets(
    session: Session, bodies: Sequence[Mapping[str, Any]]
) -> list[tuple[str, list[str]]]:
    """List the settings that differ, with the names of datasets in the place of their ids."""
    rows = list_differences(bodies)
    ids = DATASET_ID.findall(" ".join(text for _, texts in rows for text in texts))
    names = {item.id: item.name for item in describe_items(session, ids)}
    return [
        (field, [DATASET_ID.sub(lambda id_: names.get(id_[0], id_[0]), text) for text in texts])
        for field, texts in rows
    ]


def run_page(session: Session, store: ObjectStore, run_id: str, base_url: str) -> str:
    """Render the page of a run's job, with this run in full."""
    run = RunRepository(session).get(run_id)
    return job_page(session, store, run.job_id, base_url, run.id)


def datasets_page(
    session: Session,
    cursor: str | None,
    chosen: ListFilter = NO_FILTER,
    form: Mapping[str, str] | None = None,
) -> str:
    """Render the list of stored recordings, newest first; `form` is the filter as typed."""
    page = DatasetRepository(session).list_page(cursor=cursor, limit=JOBS_PER_PAGE, chosen=chosen)
    typed = dict(form or {})
    return render_template(
        "datasets.html",
        datasets=page.items,
        cursor=cursor,
        form=typed,
        filter_fields=DATASET_FILTER_FIELDS,
        filter_query=_encode_query(typed),
        next=_encode_query({**typed, "cursor": page.next}) if page.next else "",
    )


def dataset_page(session: Session, dataset_id: str) -> str:
    """Render a dataset: its signals, channels, and lineage."""
    dataset = DatasetRepository(session).get(dataset_id)
    return render_template(
        "dataset.html",
        dataset=dataset,
        etag=compute_etag(dataset),
        height=signal_figures.signals_height(dataset.n_channels),
        hold_texts=HOLD_TEXTS,
        has_history=any(channel["history_samples"] for channel in dataset.channels),
        drawing=draw_lineage(session, dataset),
    )


def load_run_row(session: Session, stored: StoredRun) -> RunView:
    """Load a run as a row of a table."""
    return to_run_view(stored, stored.result, stored.rms_unit(session), {})


def load_full_run(session: Session, store: ObjectStore, stored: StoredRun) -> RunView:
    """Load a run with explained residuals, and with the heights of its plots.

    So the page reserves their room.
    """
    result, model = load_explained_result(session, store, stored), stored.model
    has_signals = stored.run.state is JobState.SUCCEEDED
    names = list_free_parameters(session, stored)
    counts = len(model.outputs), len(model.inputs)
    # Plots that appear when the run ends lie below the live plots; they get their room then.
    heights = {
        "response": signal_figures.response_height(*counts) if has_signals else 0,
        "convergence": convergence_height(len(names), columns=3),
    }
    if result is not None:
        sampled = () if result.posterior is None else result.posterior.parameters
        heights |= {
            "correlation": correlation_height(len(names)) if result.correlation else 0,
            "disturbances": _disturbances_height(result),
            "residuals": _residuals_height(result) if has_signals else 0,
            "waterfall": WATERFALL_HEIGHT if result.islands else 0,
            "posterior": posterior_height(len(sampled)) if sampled else 0,
        }
    return to_run_view(stored, result, stored.rms_unit(session), heights)


def _disturbances_height(result: Result) -> int:
    sources = () if result.plant_noise is None else result.plant_noise.sources
    inside = sum(source.kind != "sensor" for source in sources)
    return signal_figures.disturbance_height(inside) if inside else 0


def _residuals_height(result: Result) -> int:
    tests = result.residual_tests.tests
    n_figures = sum(test.experiment == 0 and test.outcome != "not tested" for test in tests)
    return residuals_height(n_figures) if n_figures else 0


def _comparison_query(runs: Sequence[Run]) -> str:
    """Build the query that compares the models of a sweep: the first run with a result of each."""
    first: dict[str, str] = {}
    for run in runs:
        if "/model" in run.cell and run.result is not None:
            first.setdefault(repr(run.cell["/model"]), run.id)
    chosen = list(first.values())[:MAX_COMPARED_RUNS]
    return urlencode([("run", run_id) for run_id in chosen]) if len(chosen) > 1 else ""


def _noise_height(session: Session, job: Job, stored: StoredRun | None) -> int:
    """Height (px) of the figure of a sweep over σ; 0 for other jobs."""
    if job.n_runs == 1 or noise_group_keys(job.spec["sweep"]["axes"]) is None:
        return 0
    names = list_free_parameters(session, stored) if stored is not None else []
    return noise_sweep_height(1 + len(names), columns=2)


def _load_trend_view(session: Session, job: Job, outliers: OutlierRule) -> TrendView | None:
    trend = load_trend(session, job, outliers)
    return None if trend is None else to_trend_view(trend)


def _find_best_run(runs: RunRepository, job: Job) -> Run | None:
    if job.n_runs == 1 or job.best_rms is None:
        candidates: Sequence[Run] = runs.list_page(job.id, limit=1).items
    else:
        candidates = runs.list_page(job.id, limit=1, order="best_rms").items
    return candidates[0] if candidates else None


def _latest_events(session: Session, job: Job) -> list[Any]:
    # The page shows progress already, so the list has only state changes and log lines.
    return EventRepository(session).list_latest(job.id, EVENTS_SHOWN)


def _request_commands(job: JobView, base_url: str) -> list[tuple[str, str, str]]:
    url = base_url.rstrip("/")
    body = job.request_text
    curl = (
        f"curl -X POST {url}/v1/jobs -H 'Content-Type: application/json' "
        f"--data-binary @- <<'LAGID'\n{body}\nLAGID"
    )
    python = (
        f'from lagid import Client\n\nclient = Client("{url}")\n'
        f"job = client.submit({pformat(dict(job.request), width=92, sort_dicts=False)})\n"
        'client.wait(job["id"])\n'
    )
    return [("as-curl", "The same with curl", curl), ("as-python", "The same in Python", python)]


def _encode_query(values: dict[str, Any]) -> str:
    return f"?{urlencode(values, doseq=True)}" if values else ""


MAX_CHOICES = 200


def noise_sweep_page(session: Session) -> str:
    """Render the form of a noise sweep."""
    chosen = NoiseSweepIn.model_fields["methods"].default
    methods = [(method, method in chosen) for method in SEARCH_METHODS]
    return render_template(
        "noise_sweep.html",
        models=_list_models(session),
        datasets=_list_datasets(session),
        methods=methods,
    )


def reidentify_page(session: Session) -> str:
    """Render the form of a batch re-identification."""
    return render_template(
        "reidentify.html",
        models=_list_models(session),
        datasets=_list_datasets(session),
        references=ReferenceRepository(session).list_names(),
    )


def _list_models(session: Session) -> Sequence[ModelOut]:
    """List the latest version of every model."""
    return models.list_models(session, None, MAX_CHOICES, only_latest=True).items


def _list_datasets(session: Session) -> Sequence[Dataset]:
    return DatasetRepository(session).list_page(limit=MAX_CHOICES).items
