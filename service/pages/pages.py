"""The pages: what each template is given.

The pages on which a noise sweep and a batch re-identification are submitted.
"""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pprint import pformat
from typing import Any
from urllib.parse import urlencode

import yaml
from sqlalchemy.orm import Session

from service.core.text import join_estimate
from service.datasets.rms_unit import unit_of
from service.figures import signals as figures_signals
from service.figures.noise import noise_height, noise_keys
from service.figures.plotly import WATERFALL_HEIGHT, convergence_height, correlation_height
from service.figures.residuals import residuals_height
from service.jobs.stored_run import StoredRun
from service.models import models
from service.models.schemas import ModelOut
from service.pages.api_reference import operations
from service.pages.cell_grid import grid_of
from service.pages.choices import DEFAULTS, list_choices
from service.pages.dataset_links import dataset_links, unnamed
from service.pages.diagnostics import findings_of
from service.pages.figure_data import sought_parameters
from service.pages.render import render
from service.pages.trend import TrendView, trend_of, trend_view
from service.pages.views import JobView, RunView, cell_text, event_view, job_view, run_view
from service.repositories.datasets import DatasetRepository
from service.repositories.events import EventRepository
from service.repositories.jobs import JobRepository
from service.repositories.lineage import LineageRepository
from service.repositories.references import ReferenceRepository
from service.repositories.runs import RunRepository
from service.runs.comparison import compare
from service.runs.runs import wanted
from service.storage.tables import Dataset, Job, Run, State
from service.sweeps.schemas import NoiseSweepIn
from sysid.core.settings import METHODS

JOBS_PER_PAGE = 50
RUNS_PER_PAGE = 100
EVENTS_SHOWN = 100
COMPARED = 50


def reference_page(document: Mapping[str, Any]) -> str:
    """The REST interface, from its OpenAPI document."""
    about = document["info"]["description"]
    return render(
        "reference.html", about=about, version=document["info"]["version"],
        operations=operations(document),
    )  # fmt: skip


def jobs_page(session: Session, state: State | None, cursor: str | None) -> str:
    """The list of jobs and the form of a new identification."""
    states = [state] if state else []
    page = JobRepository(session).page(cursor=cursor, limit=JOBS_PER_PAGE, states=states)
    now = datetime.now(UTC)
    jobs = [job_view(job, unit_of(session, job.spec), now) for job in page.items]
    chosen = {"state": state.value} if state else {}
    return render(
        "jobs.html", jobs=jobs, state=state.value if state else "",
        states=[one.value for one in State], any_open=any(job.is_open for job in jobs),
        cursor=cursor, filter_query=_query(chosen),
        next=_query({**chosen, "cursor": page.next}) if page.next else "",
        choices=list_choices(), defaults=DEFAULTS,
    )  # fmt: skip


def job_page(
    session: Session, job_id: str, base_url: str, run_id: str | None = None,
    cursor: str | None = None, cell: Sequence[str] = (),
) -> str:  # fmt: skip
    """A job with its runs, one of them in full: the one asked for, else the best or the first.

    Of a large sweep the page has the grid of its cells, and lists the runs of the chosen `cell`,
    given as ``/noise/sigma=0.1``.
    """
    job = JobRepository(session).get(job_id)
    runs = RunRepository(session)
    chosen_cell = wanted("cell", cell)
    grid = grid_of(session, job, chosen_cell)
    is_listed = grid is None or bool(chosen_cell)
    page = runs.page(
        job.id, cursor=cursor, limit=RUNS_PER_PAGE if is_listed else 1, cell=chosen_cell
    )
    chosen = runs.get(run_id) if run_id else _best(runs, job)
    stored = StoredRun.from_rows(job, chosen) if chosen else None
    view = job_view(job, unit_of(session, job.spec), datetime.now(UTC))
    return render(
        "job.html", job=view,
        runs=[run_summary(session, StoredRun.from_rows(job, run)) for run in page.items],
        run=run_in_full(session, stored) if stored else None,
        next_runs=_query({"cell": cell, "cursor": page.next}) if page.next else "",
        grid=grid, is_listed=is_listed,
        cell_title=cell_text(chosen_cell, {}),
        noise_height=_noise_height(session, job, stored), trend=_trend(session, job),
        comparable=_comparable(page.items),
        datasets=dataset_links(session, job), more_datasets=unnamed(job),
        commands=_commands(view, base_url),
        events=[event_view(one) for one in _events(session, job)],
    )  # fmt: skip


def compare_page(session: Session, runs: Sequence[str]) -> str:
    """Runs of several models side by side.

    Raises
    ------
    InvalidRequest
        If the runs do not compare.
    """
    found = compare(session, runs)
    rows = []
    for one in found.parameters:
        known = {value.run: join_estimate(value.value, value.stderr) for value in one.values}
        texts = [known.get(run.run, "") for run in found.runs]
        rows.append({"name": one.name, "unit": one.unit, "differs": one.differs, "texts": texts})
    return render("compare.html", found=found, parameters=rows)


def run_page(session: Session, run_id: str, base_url: str) -> str:
    """The page of a run's job, with this run in full."""
    run = RunRepository(session).get(run_id)
    return job_page(session, run.job_id, base_url, run.id)


def datasets_page(session: Session, cursor: str | None) -> str:
    """The stored recordings, newest first."""
    page = DatasetRepository(session).page(cursor=cursor, limit=JOBS_PER_PAGE)
    following = _query({"cursor": page.next}) if page.next else ""
    return render("datasets.html", datasets=page.items, cursor=cursor, next=following)


def dataset_page(session: Session, dataset_id: str) -> str:
    """A dataset: its signals, channels, and lineage."""
    dataset = DatasetRepository(session).get(dataset_id)
    lineage = LineageRepository(session)
    edges = [("from", edge.parent, edge.relation) for edge in lineage.ancestors(dataset.id)
             if edge.child == dataset.id]  # fmt: skip
    edges += [("for", edge.child, edge.relation) for edge in lineage.descendants(dataset.id)
              if edge.parent == dataset.id]  # fmt: skip
    return render(
        "dataset.html", dataset=dataset, height=figures_signals.signals_height(dataset.n_channels),
        has_history=any(one["history_samples"] for one in dataset.channels),
        lineage=[
            {"direction": direction, "id": name, "relation": relation, "href": _href(name)}
            for direction, name, relation in edges
        ],
    )  # fmt: skip


def model_text(session: Session, name: str) -> str:
    """A model as YAML, to be read in the form and changed there."""
    return _as_yaml(models.one(session, name).document)


def job_model_text(session: Session, job_id: str) -> str:
    """The model document of a job as YAML, for a job that is cloned."""
    model = JobRepository(session).get(job_id).spec["model"]
    return _as_yaml(models.one(session, model).document if isinstance(model, str) else model)


def _as_yaml(document: dict[str, Any] | None) -> str:
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=100)


def run_summary(session: Session, stored: StoredRun) -> RunView:
    """A run as a line of a table."""
    return run_view(stored.run, stored.rms_unit(session), {})


def run_in_full(session: Session, stored: StoredRun) -> RunView:
    """A run with what its plots need to be laid out before they are drawn."""
    run, result, model = stored.run, stored.result, stored.model
    sought = sought_parameters(session, stored)
    counts = len(model.outputs), len(model.inputs)
    # What comes with the end of the run lies below the live plots and takes its room then.
    heights = {
        "response": figures_signals.response_height(*counts) if run.signals_sha256 else 0,
        "convergence": convergence_height(len(sought), columns=3),
        "correlation": correlation_height(len(sought)) if result.get("correlation") else 0,
        "residuals": _residuals_height(result) if run.signals_sha256 else 0,
        "waterfall": WATERFALL_HEIGHT if result.get("islands") else 0,
    }
    return run_view(run, stored.rms_unit(session), heights)


def _residuals_height(result: Mapping[str, Any]) -> int:
    n_figures = findings_of(result).n_figures
    return residuals_height(n_figures) if n_figures else 0


def _comparable(runs: Sequence[Run]) -> str:
    """Query of a comparison of a sweep over models, of the first of each that has a result."""
    first: dict[str, str] = {}
    for run in runs:
        if "/model" in run.cell and run.result is not None:
            first.setdefault(repr(run.cell["/model"]), run.id)
    chosen = list(first.values())[:COMPARED]
    return urlencode([("run", one) for one in chosen]) if len(chosen) > 1 else ""


def _noise_height(session: Session, job: Job, stored: StoredRun | None) -> int:
    """Height (px) of the figure of a sweep over σ; 0 where it is none."""
    if job.n_runs == 1 or noise_keys(job.spec["sweep"]["axes"]) is None:
        return 0
    sought = sought_parameters(session, stored) if stored is not None else []
    return noise_height(1 + len(sought), columns=2)


def _trend(session: Session, job: Job) -> TrendView | None:
    found = trend_of(session, job)
    return None if found is None else trend_view(found)


def _best(runs: RunRepository, job: Job) -> Run | None:
    if job.n_runs == 1 or job.best_rms is None:
        found: Sequence[Run] = runs.page(job.id, limit=1).items
    else:
        found = runs.page(job.id, limit=1, order="best_rms").items
    return found[0] if found else None


def _events(session: Session, job: Job) -> list[Any]:
    # Progress is on the page already; what remains are the few lines that tell a story.
    return EventRepository(session).latest(job.id, EVENTS_SHOWN, kinds=("state", "log", "end"))


def _commands(job: JobView, base_url: str) -> list[tuple[str, str, str]]:
    url = base_url.rstrip("/")
    body = job.request_text
    curl = (
        f"curl -X POST {url}/v1/jobs -H 'Content-Type: application/json' "
        f"--data-binary @- <<'LAGID'\n{body}\nLAGID"
    )
    python = (
        f'from service.client.client import Client\n\nclient = Client("{url}")\n'
        f"job = client.submit({pformat(dict(job.request), width=92, sort_dicts=False)})\n"
        'client.wait(job["id"])\n'
    )
    return [("as-curl", "The same with curl", curl), ("as-python", "The same in Python", python)]


def _href(name: str) -> str:
    kind = name.partition("_")[0]
    return {"ds": "/datasets/", "job": "/jobs/", "run": "/runs/"}.get(kind, "/v1/") + name


def _query(values: dict[str, Any]) -> str:
    return f"?{urlencode(values, doseq=True)}" if values else ""


LISTED = 200


def noise_sweep_page(session: Session) -> str:
    """The form of a noise sweep."""
    chosen = NoiseSweepIn.model_fields["methods"].default
    methods = [(one, one in chosen) for one in METHODS]
    return render(
        "noise_sweep.html", models=_models(session), datasets=_datasets(session), methods=methods
    )


def reidentify_page(session: Session) -> str:
    """The form of a batch re-identification."""
    return render(
        "reidentify.html", models=_models(session), datasets=_datasets(session),
        references=ReferenceRepository(session).names(),
    )  # fmt: skip


def _models(session: Session) -> Sequence[ModelOut]:
    """Every model once, under the name that means its latest version."""
    found = models.page(session, None, LISTED).items
    return list({one.name: one for one in reversed(found)}.values())[::-1]


def _datasets(session: Session) -> Sequence[Dataset]:
    return DatasetRepository(session).page(limit=LISTED).items
