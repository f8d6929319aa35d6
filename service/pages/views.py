"""What the templates show of jobs and runs: values of their rows, ready to be written."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from service.figures import formats
from service.pages.diagnostics import Findings, findings_of
from service.storage.tables import Event, Job, Run, State

Document = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class EstimateView:
    """One line of the table of estimates."""

    name: str
    unit: str
    value_text: str
    stderr_text: str
    interval_text: str
    bounds_text: str
    status: str
    reason: str


DATASETS = "/datasets"


@dataclass(frozen=True, slots=True)
class RunView:
    """One run: what it gave, or how far it is."""

    id: str
    number: int
    title: str
    state: str
    is_open: bool
    cell_text: str
    unit: str
    valid: bool | None
    best_rms: float | None
    fit_estimation: float | None
    fit_validation: float | None
    evaluations: int
    generations: int
    seconds: float | None
    error: str | None
    estimates: Sequence[EstimateView]
    warnings: Sequence[str]
    has_signals: bool
    heights: Mapping[str, int]
    findings: Findings


@dataclass(frozen=True, slots=True)
class JobView:
    """One job: its state, how far it is, and its request.

    The RMS of a batch, whose runs see different recordings, do not compare: it has no best one.
    """

    id: str
    name: str
    state: str
    is_open: bool
    can_resume: bool
    cancel_requested: bool
    model_name: str
    unit: str
    starts: int
    lost_leases: int
    max_attempts: int
    n_runs: int
    n_done: int
    n_failed: int
    n_reused: int
    progress: float
    progress_text: str
    best_rms: float | None
    is_batch: bool
    evaluations: int
    rate: float | None
    seconds_left: float | None
    took: float | None
    created_at: datetime
    error: str | None
    request: Document

    @property
    def request_text(self) -> str:
        """The request as it was submitted, for reading."""
        return json.dumps(self.request, indent=2, ensure_ascii=False)


@dataclass(frozen=True, slots=True)
class EventView:
    """One line of a job's events."""

    at: datetime
    kind: str
    text: str


def job_view(job: Job, unit: str, now: datetime) -> JobView:
    """What pages show of a job; `unit` is that of its RMS."""
    took = None if job.started_at is None else ((job.finished_at or now) - job.started_at)
    seconds = None if took is None else max(took.total_seconds(), 0.0)
    share = progress(job)
    is_batch = any(axis["path"].startswith(DATASETS) for axis in axes_of(job.spec))
    return JobView(
        id=job.id, name=job.name, state=job.state.value, is_open=not job.state.is_terminal,
        can_resume=job.state in (State.FAILED, State.CANCELLED),
        cancel_requested=job.cancel_requested, model_name=model_name(job.spec), unit=unit,
        starts=job.attempt, lost_leases=job.lost_leases, max_attempts=job.max_attempts,
        n_runs=job.n_runs, n_done=job.n_done,
        n_failed=job.n_failed, n_reused=job.n_reused,
        progress=share, progress_text=_progress_text(job, share),
        best_rms=None if is_batch else job.best_rms, is_batch=is_batch, evaluations=job.evaluations,
        rate=job.evaluations / seconds if seconds and job.evaluations else None,
        seconds_left=job.seconds_left, took=seconds, created_at=job.created_at,
        error=job.error, request=job.spec,
    )  # fmt: skip


def run_view(run: Run, unit: str, heights: Mapping[str, int]) -> RunView:
    """What pages show of a run; `heights` (px) are those of its plots."""
    result = run.result or {}
    return RunView(
        id=run.id, number=run.number, title=_run_title(run), state=run.state.value,
        is_open=not run.state.is_terminal, cell_text=cell_text(run.cell, run.labels), unit=unit,
        valid=run.valid, best_rms=run.best_rms, fit_estimation=run.fit_estimation,
        fit_validation=run.fit_validation, evaluations=run.evaluations,
        generations=run.generations, seconds=run.seconds, error=run.error,
        estimates=[estimate_view(one) for one in result.get("parameters", ())],
        warnings=list(result.get("warnings", ())), has_signals=run.signals_sha256 is not None,
        heights=heights, findings=findings_of(result),
    )  # fmt: skip


def estimate_view(one: Document) -> EstimateView:
    """A line of the table, from an entry of the result's ``parameters``."""
    stderr = one["stderr"]
    value, error = formats.estimate(one["value"], stderr)
    bounds = [one[name] for name in ("lower", "upper") if one[name] is not None]
    return EstimateView(
        name=one["name"], unit=one["unit"], value_text=value, stderr_text=error,
        interval_text=formats.interval(one["interval95"], stderr),
        bounds_text=" … ".join(f"{bound:.6g}".replace("-", "−") for bound in bounds),
        status=one["status"], reason=one["reason"] or "",
    )  # fmt: skip


def event_view(event: Event) -> EventView:
    """An event as one line of text."""
    data = event.data
    if event.kind in ("state", "end"):
        attempt = f", attempt {data['attempt']}" if data.get("attempt") else ""
        error = f": {data['error']}" if data.get("error") else ""
        return EventView(event.created_at, event.kind, f"{data.get('state', '')}{attempt}{error}")
    text = data.get("message")
    if text is None:
        known = ((name.replace("_", " "), value) for name, value in data.items())
        text = ", ".join(f"{name} {_plain(value)}" for name, value in known if value is not None)
    return EventView(event.created_at, event.kind, str(text))


def model_name(spec: Document) -> str:
    """Name of the model that a job names or carries."""
    model = spec["model"]
    return model if isinstance(model, str) else str(model.get("name", "own equations"))


def progress(job: Job) -> float:
    """How much of a job is done, from 0 to 1: runs, and the generations of a single one."""
    if job.state is State.SUCCEEDED:
        return 1.0
    if job.n_runs > 1 or job.state is State.QUEUED:
        return min(job.n_done / max(job.n_runs, 1), 1.0)
    algorithm = job.spec["algorithm"]
    budget = algorithm["stop"]["evaluations"]
    parts: list[float] = [job.generation / algorithm["generations"]]
    if budget:
        parts.append(job.evaluations / budget)
    return min(max(parts), 1.0)


def axes_of(spec: Document) -> list[Document]:
    """The axes of a job's sweep."""
    return list(spec["sweep"]["axes"])


def cell_text(cell: Document, labels: Document) -> str:
    """What distinguishes a run from the others of its job; labels tell data better than ids."""
    told = {path: value for path, value in cell.items() if not (labels and path == DATASETS)}
    pairs = [(_field_name(path, told), value) for path, value in told.items()]
    return ", ".join(f"{name} {_plain(value)}" for name, value in [*labels.items(), *pairs])


def _field_name(path: str, others: Iterable[str]) -> str:
    """Last part of a pointer; all of it where others end like it, as those of two seeds do."""
    last = path.rsplit("/", 1)[-1]
    same = [one for one in others if one.rsplit("/", 1)[-1] == last]
    return last if len(same) == 1 else path.removeprefix("/").replace("/", " ")


def _run_title(run: Run) -> str:
    return f"run {run.number + 1}"


def _progress_text(job: Job, share: float) -> str:
    if job.n_runs > 1:
        return f"{formats.count(job.n_done)} of {formats.count(job.n_runs)} runs"
    if job.state is State.QUEUED:
        return "waiting"
    if job.state is not State.SUCCEEDED:
        return f"generation {formats.count(job.generation)}" if job.generation else ""
    return f"{100 * share:.0f}\u202f%"


def _plain(value: object) -> str:
    if isinstance(value, float):
        return formats.number(value)
    if isinstance(value, dict | list):
        text = json.dumps(value, ensure_ascii=False)
        return text if len(text) <= 60 else f"{text[:57]}…"
    return str(value)
