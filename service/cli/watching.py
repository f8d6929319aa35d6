"""Live progress of a job: one bar a run, with its RMS; one bar for all where there are many.

Where nobody looks (a file, a pipe) there are lines instead: at every change of state, and every
`EVERY_S` at most.
"""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from service.client import Client

MANY = 12
EVERY_S = 10.0
COLUMNS = (
    TextColumn("{task.description:<24.24}", markup=False),
    BarColumn(bar_width=30),
    TextColumn("{task.percentage:>3.0f} %"),
    TextColumn("RMS {task.fields[rms]}"),
    TextColumn("{task.fields[state]}"),
    TimeElapsedColumn(),
)


def follow(client: "Client", job_id: str, *, quiet: bool = False) -> dict[str, Any]:
    """Show a job until it ends; its last state."""
    if quiet:
        return client.wait(job_id)
    first = client.job(job_id)
    console = Console(stderr=True, highlight=False)
    if not console.is_terminal:
        unit = first["rms_unit"]
        return client.wait(job_id, progress=Lines(lambda text: _print(console, text), unit).show)
    with Progress(*COLUMNS, console=console, refresh_per_second=5) as progress:
        bars = _Bars(client, progress, many=first["progress"]["runs"] > MANY)
        return client.wait(job_id, progress=bars.show)


class Lines:
    """Lines of one job for a log.

    Parameters
    ----------
    tell : callable
        Takes a line.
    unit : str or None
        Of the best RMS.
    clock : callable
        Seconds that never go back.
    """

    def __init__(
        self, tell: Callable[[str], object], unit: str | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._tell, self._unit, self._clock = tell, unit, clock
        self._state, self._last, self._text = "", 0.0, ""

    def show(self, job: dict[str, Any]) -> None:
        """Tell what is new, if its state changed or the last line is old enough."""
        now, text = self._clock(), self._line(job)
        is_due = now - self._last >= EVERY_S and text != self._text
        if job["state"] == self._state and not is_due:
            return
        self._state, self._last, self._text = job["state"], now, text
        self._tell(text)

    def _line(self, job: dict[str, Any]) -> str:
        done = job["progress"]
        told = [f"{job['id']} {job['state']}", f"{done['finished']}/{done['runs']} runs"]
        if done["runs"] == 1 and done["generation"]:
            told.append(f"generation {done['generation']}")
        if done["best_rms"] is not None:
            unit = "" if self._unit in (None, "1") else f" {self._unit}"
            told.append(f"best RMS {done['best_rms']:.6g}{unit}")
        return ", ".join(told)


class _Bars:
    """The bars of one job, brought up to date at every look."""

    def __init__(self, client: "Client", progress: Progress, *, many: bool) -> None:
        self._client, self._progress, self._many = client, progress, many
        self._bars: dict[str, TaskID] = {}

    def show(self, job: dict[str, Any]) -> None:
        done = job["progress"]
        if self._many:
            part = done["finished"] / done["runs"]
            label = f"{done['finished']}/{done['runs']} runs"
            self._update(job["id"], label, part, done["best_rms"], job["state"])
            return
        for run in self._client.runs(job["id"]):
            rms = run["rms"]
            self._update(run["id"], _label(job, run), run["progress"], rms, run["state"])

    def _update(self, key: str, label: str, part: float, rms: float | None, state: str) -> None:
        if key not in self._bars:
            self._bars[key] = self._progress.add_task(label, total=1.0, rms="–", state=state)
        text = "–" if rms is None else f"{rms:.6g}"
        self._progress.update(
            self._bars[key], description=label, completed=part, rms=text, state=state
        )


def _print(console: Console, text: str) -> None:
    console.print(text, markup=False, soft_wrap=True)


def _label(job: dict[str, Any], run: dict[str, Any]) -> str:
    values = [value for value in run["cell"].values() if not isinstance(value, dict | list)]
    return ", ".join(str(value) for value in values) or str(job["name"])
