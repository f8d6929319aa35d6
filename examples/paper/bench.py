"""Submit the jobs of the study, wait for them, and read the data of the figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from examples.paper.document import format_estimate
from lagid import Client

Document = Mapping[str, Any]
METHODS = ("simple", "improved-paper", "improved")
RESPONSE_POINTS = 700


class StudyFailed(Exception):
    """A job of the study did not succeed."""

    def __init__(self, name: str, job: Document) -> None:
        reason = job.get("error") or f"{job['progress']['failed']} of its runs failed"
        super().__init__(f"the job {name!r} ({job['id']}) {job['state']}: {reason}")


@dataclass(frozen=True, slots=True)
class ArchipelagoImprovement:
    """A better champion of a whole archipelago."""

    generation: int
    rms: float
    parameters: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class MethodRun:
    """One run: its result document, its champion's progress, its response."""

    run: Document
    progress: Sequence[ArchipelagoImprovement]
    response: Document

    def get_estimate(self, name: str) -> float:
        """Return the estimate of a parameter."""
        return float(self.get_parameter(name)["value"])

    def format_estimate(self, name: str) -> str:
        """Format an estimate with its standard error, or with its status if there is none."""
        parameter = self.get_parameter(name)
        value, stderr = parameter["value"], parameter["stderr"]
        return format_estimate(value, stderr) if stderr else f"{value:.6g} ({parameter['status']})"

    def get_parameter(self, name: str) -> Document:
        """Return the entry of one parameter."""
        return next(parameter for parameter in self.run["parameters"] if parameter["name"] == name)


@dataclass(frozen=True, slots=True)
class StudyBench:
    """Client of the service for the study; `quick` requests smaller jobs, `say` shows progress."""

    client: Client
    quick: bool
    say: Callable[[str], object]

    def run_job(self, body: Document) -> Sequence[Mapping[str, Any]]:
        """Submit one job and wait for its runs.

        Raises
        ------
        StudyFailed
            If the job or one of its runs failed.
        """
        name = str(body["name"])
        self.say(name)
        job = self.client.submit(body)
        ended = self.client.wait(job["id"], poll=0.15)
        if ended["state"] != "succeeded" or ended["progress"]["failed"]:
            raise StudyFailed(name, ended)
        return self.client.runs(job["id"])

    def compare_methods(self, body: Document) -> dict[str, MethodRun]:
        """Run one job that compares the three methods on one problem: method → its run."""
        axes = [{"path": "/algorithm/method", "values": list(METHODS)}]
        runs = self.run_job({**body, "sweep": {"axes": axes}})
        return {run["cell"]["/algorithm/method"]: self.read_run(run) for run in runs}

    def read_run(self, run: Document) -> MethodRun:
        """Read a run with its history and response."""
        history = self.client.history(run["id"])
        response = self.client.response(run["id"], max_points=RESPONSE_POINTS)
        return MethodRun(run, champion_history(history), response)


def champion_history(history: Document) -> list[ArchipelagoImprovement]:
    """Compute the best of all islands over the generations, from each island's history."""
    points = [point for island in history["islands"] for point in island]
    improvements: list[ArchipelagoImprovement] = []
    for point in sorted(points, key=lambda point: (point["generation"], -point["rms"])):
        if improvements and point["rms"] >= improvements[-1].rms:
            continue
        values = dict(zip(history["names"], point["parameters"], strict=True))
        improvements.append(ArchipelagoImprovement(point["generation"], point["rms"], values))
    return improvements
