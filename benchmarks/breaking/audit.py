"""What became of jobs: nothing lost, nothing doubled, and the numbers of an undisturbed run."""

import json
from collections import Counter
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select

from benchmarks.breaking.stand import Stand
from service.storage.patience import PASSING
from service.storage.tables import Event, Job, Run, RunHistory, State

CLOCKED = ("seconds", "job")
"""Fields of a summary that tell of time and place, not of the result."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One job after its end.

    Attributes
    ----------
    states : tuple of str
        Of its runs, in the order of the sweep.
    doubled : int
        Runs, ends or counts that are there more than once.
    given_up : bool
        Whether the job failed because its dispatchers ended or fell silent too often.
    figures : str
        Summary, evaluations and history, without clock fields, as text: equal for equal bits.
    """

    states: tuple[str, ...]
    doubled: int
    given_up: bool
    figures: str

    def lost_beside(self, undisturbed: "Finding") -> int:
        """Runs that did not come to the end they had there."""
        pairs = zip(self.states, undisturbed.states, strict=False)
        missing = max(0, len(undisturbed.states) - len(self.states))
        return missing + sum(mine != theirs for mine, theirs in pairs)


def audit(stand: Stand, job_id: str) -> Finding:
    """Count what a job has left in the tables, and take its summary over REST."""
    with stand.database.read() as session:
        job = session.get_one(Job, job_id)
        runs = list(session.scalars(select(Run).where(Run.job_id == job_id).order_by(Run.number)))
        kinds = session.execute(select(Event.kind, Event.data).where(Event.job_id == job_id))
        ends = sum(State(data["state"]).is_terminal for kind, data in kinds if kind == "state")
        points = select(func.count()).where(RunHistory.run_id.in_([run.id for run in runs]))
        n_points = session.scalar(points)
    numbers = Counter(run.number for run in runs)
    doubled = sum(numbers.values()) - len(numbers) + max(0, job.n_done - job.n_runs)
    doubled += max(0, ends - 1)
    summary = without_clock(stand.client.summary(job_id))
    total = sum(run.evaluations for run in runs)
    figures = [summary, job.evaluations, total, n_points, [run.estimates for run in runs]]
    given_up = job.state is State.FAILED and job.lost_leases >= job.max_attempts
    states = tuple(run.state.value for run in runs)
    return Finding(states, doubled, given_up, json.dumps(figures, sort_keys=True))


def without_clock(document: Any) -> Any:
    """The document without what tells of time and place."""
    if isinstance(document, dict):
        return {k: without_clock(v) for k, v in document.items() if k not in CLOCKED}
    if isinstance(document, list):
        return [without_clock(one) for one in document]
    return document


def is_over(stand: Stand, job_id: str) -> bool:
    """Whether a job has ended; False while the database is away."""
    try:
        with stand.database.read() as session:
            return session.get_one(Job, job_id).state.is_terminal
    except PASSING:
        return False


def steps(stand: Stand, jobs: list[str]) -> int | None:
    """A number that grows with the work on jobs; None while the database is away."""
    try:
        with stand.database.read() as session:
            ended = select(func.count()).where(Run.job_id.in_(jobs), Run.state == State.SUCCEEDED)
            return int(session.scalar(ended) or 0)
    except PASSING:
        return None


def owners(stand: Stand) -> set[str]:
    """Dispatchers that hold a lease."""
    with stand.database.read() as session:
        held = select(Job.lease_owner).where(Job.state == State.RUNNING)
        return {str(one) for one in session.scalars(held)}
