"""Live progress of a job: one bar a run, with its RMS; one bar for all where there are many."""

from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from service.client import Client

MANY = 12
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
    with Progress(*COLUMNS, console=console, refresh_per_second=5) as progress:
        bars = _Bars(client, progress, many=first["progress"]["runs"] > MANY)
        return client.wait(job_id, progress=bars.show)


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


def _label(job: dict[str, Any], run: dict[str, Any]) -> str:
    values = [value for value in run["cell"].values() if not isinstance(value, dict | list)]
    return ", ".join(str(value) for value in values) or str(job["name"])
