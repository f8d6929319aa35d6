"""Views of jobs and runs for the templates: their documents with formatted texts."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy.orm import Session

from service.core.bodies.job_fields import DATASETS_PATH
from service.core.bodies.wire import Answer
from service.core.label_text import format_count, format_value
from service.core.states import OPEN_STATES, JobState, RunStateName, describe_state
from service.datasets.rms_unit import find_rms_unit
from service.items.items import compute_etag
from service.jobs.job_schemas import JobOut, OutcomeOut
from service.jobs.outcomes import is_batch
from service.jobs.stored_run import StoredRun
from service.jobs.submit import to_job_out
from service.storage.clocks import choose_database_clock
from service.storage.tables import Event, Job
from sysid.results.result import Result

Document = Mapping[str, Any]


class RunView(Answer):
    """View of a run: its progress, then its `Result`; None until there is one."""

    id: str
    number: int
    title: str
    state: RunStateName
    is_open: bool
    cell_text: str
    unit: str
    best_rms: float | None
    fit_estimation: float | None
    fit_validation: float | None
    evaluations: int
    generations: int
    seconds: float | None
    error: str | None
    result: Any
    note: str | None
    tags: Sequence[str]
    etag: str
    has_signals: bool
    heights: Mapping[str, int]
    model: Any


class JobView(JobOut):
    """View of a job: its REST document and further texts of the pages.

    The runs of a batch see different recordings, so their RMS cannot be compared. A batch therefore
    has no best RMS.
    """

    request: dict[str, Any]
    lost_leases: int
    max_attempts: int

    @property
    def is_open(self) -> bool:
        """Whether the job waits or runs."""
        return self.state in OPEN_STATES

    @property
    def can_resume(self) -> bool:
        """Whether the job ended before it was done, or with failed runs."""
        return self.state in ("failed", "cancelled") or self.has_failed_runs

    @property
    def has_failed_runs(self) -> bool:
        """Whether some of the runs of a job that has ended have failed."""
        return self.state == "incomplete"

    @property
    def state_text(self) -> str:
        """State in words."""
        return describe_state(self.state, self.progress.failed, self.progress.runs)

    @property
    def is_batch(self) -> bool:
        """Whether the job's runs see different recordings."""
        return is_batch(self.request)

    @property
    def best_rms(self) -> float | None:
        """RMS of the best run."""
        return None if self.is_batch else self.progress.best_rms

    @property
    def outcome_place(self) -> str:
        """Place in the sweep of the run that stands for the job; empty for a single run."""
        return "" if self.outcome is None else format_cell(self.outcome.cell, self.outcome.labels)

    @property
    def rate(self) -> float | None:
        """Evaluations per second."""
        seconds, evaluations = self.seconds, self.progress.evaluations
        return evaluations / seconds if seconds and evaluations else None

    @property
    def share(self) -> float:
        """Share that is done, from 0 to 1: by runs, or by generations of a single run."""
        done = self.progress
        if self.state in ("succeeded", "incomplete"):
            return 1.0
        if done.runs > 1 or self.state == "queued":
            return min(done.finished / max(done.runs, 1), 1.0)
        algorithm = self.request["algorithm"]
        parts: list[float] = [done.generation / max(algorithm["generations"], 1)]
        if budget := algorithm["stop"]["evaluations"]:
            parts.append(done.evaluations / budget)
        return min(max(parts), 1.0)

    @property
    def progress_text(self) -> str:
        """Progress in words."""
        done = self.progress
        if done.runs > 1:
            return f"{format_count(done.finished)} of {format_count(done.runs)} runs"
        if self.state == "queued":
            return "waiting"
        if self.state != "succeeded":
            return f"generation {format_count(done.generation)}" if done.generation else ""
        return f"{100 * self.share:.0f}\u202f%"

    @property
    def request_text(self) -> str:
        """The request as it was submitted, as indented JSON."""
        return json.dumps(self.request, indent=2, ensure_ascii=False)


@dataclass(frozen=True, slots=True)
class EventView:
    """One row of a job's events."""

    at: datetime
    kind: str
    text: str


def to_job_view(session: Session, job: Job, outcome: OutcomeOut | None = None) -> JobView:
    """Build the view of a job."""
    document = to_job_out(
        job,
        choose_database_clock(session),
        with_request=True,
        rms_unit=find_rms_unit(session, job.spec),
        outcome=outcome,
    )
    return JobView.from_source(document, lost_leases=job.lost_leases, max_attempts=job.max_attempts)


def to_run_view(
    stored: StoredRun, result: Result | None, unit: str, heights: Mapping[str, int]
) -> RunView:
    """Build the view of a run and its result; `heights` (px) are those of its plots."""
    run = stored.run
    return RunView.from_source(
        run,
        title=f"run {run.number + 1}",
        is_open=not run.state.is_terminal,
        cell_text=format_cell(run.cell, run.labels),
        unit=unit,
        result=result,
        tags=run.tags or (),
        etag=compute_etag(run),
        has_signals=run.state is JobState.SUCCEEDED,
        heights=heights,
        model=stored.model,
    )


def to_event_view(event: Event) -> EventView:
    """Format an event as one line of text."""
    data = event.data
    if event.kind in ("state", "end"):
        attempt = f", attempt {data['attempt']}" if data.get("attempt") else ""
        error = f": {data['error']}" if data.get("error") else ""
        return EventView(event.created_at, event.kind, f"{data.get('state', '')}{attempt}{error}")
    text = data.get("message")
    if text is None:
        entries = ((name.replace("_", " "), value) for name, value in data.items())
        text = ", ".join(
            f"{name} {format_value(value)}" for name, value in entries if value is not None
        )
    return EventView(event.created_at, event.kind, str(text))


def sweep_axes(spec: Document) -> list[Document]:
    """List the axes of a job's sweep."""
    return list(spec["sweep"]["axes"])


def format_cell(cell: Document, labels: Document) -> str:
    """Describe a run's place in its sweep; labels replace the ids of datasets."""
    shown = {path: value for path, value in cell.items() if not (labels and path == DATASETS_PATH)}
    pairs = [(_axis_name(path, shown), value) for path, value in shown.items()]
    return ", ".join(f"{name} {format_value(value)}" for name, value in [*labels.items(), *pairs])


def _axis_name(path: str, others: Iterable[str]) -> str:
    """Last part of a pointer; the whole pointer if others end alike, such as two seeds."""
    last = path.rsplit("/", 1)[-1]
    same = [path for path in others if path.rsplit("/", 1)[-1] == last]
    return last if len(same) == 1 else path.removeprefix("/").replace("/", " ")
