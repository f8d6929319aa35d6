"""Show the progress of a job: one bar per run with its RMS, or one bar for many runs.

In a file or a pipe, lines replace the bars: one at every change of state, and at most one every
`LOG_INTERVAL_SECONDS`. For many runs both show how many are done and how fast. They omit the best
RMS, since RMS on different data or under different noise cannot be compared.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from service.cli.common import Document, PlainConsole, err
from service.client.calls import TERMINAL_STATES
from service.core.bodies.text_checks import escape_controls
from service.core.label_text import format_duration, format_value
from sysid.core.text import plain_unit

if TYPE_CHECKING:
    from service.client.client import Client
    from service.client.documents import JobDocument


MAX_BARS = 12
LOG_INTERVAL_SECONDS = 10.0
RUN_POLL_SECONDS = 1.0
"""Shortest interval between two requests for the run that ended last."""
BAR_COLUMNS = (
    TextColumn("{task.description:<24.24}", markup=False),
    BarColumn(bar_width=30),
    TextColumn("{task.percentage:>3.0f} %"),
    TextColumn("{task.fields[text]}", markup=False),
    TextColumn("{task.fields[state]}"),
    TimeElapsedColumn(),
)
Clock = Callable[[], float]


def follow_job(client: "Client", job_id: str, *, quiet: bool = False) -> "JobDocument":
    """Show a job until it ends, unless told to be quiet; return its last state."""
    if quiet or err.quiet:
        return client.wait(job_id)
    first = client.job(job_id)
    console = PlainConsole(stderr=True, highlight=False)
    runs = RunsProgress(lambda: _find_newest_run(client, job_id), first["rms_unit"])
    if not console.is_terminal:
        lines = ProgressLog(partial(console.print, markup=False, soft_wrap=True), runs)
        return client.wait(job_id, progress=lines.log_progress)
    with Progress(*BAR_COLUMNS, console=console, refresh_per_second=5) as progress:
        bars = _ProgressBars(client, progress, runs, is_one=first["progress"]["runs"] > MAX_BARS)
        return client.wait(job_id, progress=bars.update_bars)


class RunsProgress:
    """Progress text of a job's runs: failed and reused, their pace, the run that ended last.

    Parameters
    ----------
    find_newest : callable
        Returns the run that ended last, or None.
    unit : str or None
        Unit of the RMS.
    clock : callable
        Monotonic clock in seconds.
    """

    def __init__(
        self,
        find_newest: Callable[[], Document | None],
        unit: str | None = None,
        clock: Clock = time.monotonic,
    ) -> None:
        self._find_newest, self.unit, self.clock = find_newest, unit, clock
        self._begun: tuple[float, int] | None = None
        self._last_request, self._seen, self._text = 0.0, 0, ""

    def describe_progress(self, job: Document) -> list[str]:
        """Return the parts of a progress line of a job with several runs."""
        done, is_over = job["progress"], job["state"] in TERMINAL_STATES
        parts = [f"{done[what]} {what}" for what in ("failed", "reused") if done[what]]
        if is_over:
            return parts
        pace = self._runs_per_second(done["finished"]) if job["state"] == "running" else 0.0
        parts += [f"{pace:.3g} runs/s"] if pace > 0 else []
        if done["seconds_left"] is not None:
            parts.append(f"{format_duration(done['seconds_left'])} left".replace("\u202f", " "))
        return [*parts, *([text] if (text := self._describe_last_run(done["finished"])) else [])]

    def format_rms(self, value: float | None) -> str:
        """Format an RMS with its unit."""
        return "RMS –" if value is None else f"RMS {value:.6g}{plain_unit(self.unit)}"

    def _runs_per_second(self, finished: int) -> float:
        """Return the runs per second since the running job was first seen."""
        now = self.clock()
        if self._begun is None:
            self._begun = now, finished
        since, before = self._begun
        return (finished - before) / (now - since) if now > since else 0.0

    def _describe_last_run(self, finished: int) -> str:
        now = self.clock()
        if finished != self._seen and (
            not self._seen or now - self._last_request >= RUN_POLL_SECONDS
        ):
            self._last_request, self._seen = now, finished
            run = self._find_newest()
            self._text = "" if run is None else f"last {self._describe_run(run)}"
        return self._text

    def _describe_run(self, run: Document) -> str:
        cell = _describe_cell(run)
        outcome = self.format_rms(run["rms"]) if run["state"] == "succeeded" else run["state"]
        return f"run {run['number'] + 1}{f' ({cell})' if cell else ''}: {outcome}"


class ProgressLog:
    """Progress lines of one job for a log; `write_line` writes a line."""

    def __init__(self, write_line: Callable[[str], object], runs: RunsProgress) -> None:
        self._write_line, self._runs = write_line, runs
        self._state, self._last, self._text = "", 0.0, ""

    def log_progress(self, job: Document) -> None:
        """Write a line if the state has changed or the last line is old enough."""
        now = self._runs.clock()
        if job["state"] == self._state and now - self._last < LOG_INTERVAL_SECONDS:
            return
        text = self._format_line(job)
        if job["state"] == self._state and text == self._text:
            return
        self._state, self._last, self._text = job["state"], now, text
        self._write_line(text)

    def _format_line(self, job: Document) -> str:
        done = job["progress"]
        parts = [f"{job['id']} {job['state']}", f"{done['finished']}/{done['runs']} runs"]
        if done["runs"] > 1:
            return ", ".join([*parts, *self._runs.describe_progress(job)])
        if done["generation"]:
            parts.append(f"generation {done['generation']}")
        if done["best_rms"] is not None:
            parts.append(self._runs.format_rms(done["best_rms"]))
        return ", ".join(parts)


class _ProgressBars:
    """Progress bars of one job: one for all runs, or one per run."""

    def __init__(
        self, client: "Client", progress: Progress, runs: RunsProgress, *, is_one: bool
    ) -> None:
        self._client, self._progress, self._runs = client, progress, runs
        self._is_one = is_one
        self._bars: dict[str, TaskID] = {}

    def update_bars(self, job: Document) -> None:
        done = job["progress"]
        if self._is_one:
            part = done["finished"] / done["runs"]
            label = f"{done['finished']}/{done['runs']} runs"
            self._update_bar(
                job["id"], label, part, ", ".join(self._runs.describe_progress(job)), job["state"]
            )
            return
        for run in self._client.runs(job["id"]):
            label = _describe_cell(run) or str(job["name"])
            self._update_bar(
                run["id"], label, run["progress"], self._runs.format_rms(run["rms"]), run["state"]
            )

    def _update_bar(self, key: str, label: str, part: float, text: str, state: str) -> None:
        label, text = escape_controls(label), escape_controls(text)
        if key not in self._bars:
            self._bars[key] = self._progress.add_task(label, total=1.0, text=text, state=state)
        self._progress.update(
            self._bars[key], description=label, completed=part, text=text, state=state
        )


def _find_newest_run(client: "Client", job_id: str) -> Document | None:
    """Find the ended run with the highest number; runs start in the order of their numbers."""
    ended = ["succeeded", "failed"]
    runs = client.runs(job_id, at_most=1, state=ended, order="number", descending=True)
    return runs[0] if runs else None


def _describe_cell(run: Document) -> str:
    """Describe a run by its labels and axis values, except datasets and models."""
    values = [*run["labels"].values(), *run["cell"].values()]
    return ", ".join(format_value(value) for value in values if not isinstance(value, dict | list))
