"""Audit jobs after faults: nothing lost or doubled, and the numbers of an undisturbed run."""

import json
from collections import Counter, defaultdict
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from benchmarks.breaking.stand import Stand
from service.core.states import JobState
from service.repositories.history_rows import unpack_history, unpack_migrants
from service.storage.retry import TRANSIENT_ERRORS
from service.storage.tables import Event, Job, MigrationLog, Parcel, Run, RunHistory

CLOCKED = ("seconds", "job", "run")
"""Fields of a summary that tell of time and place, not of the result."""
KILLED = "its worker process died"
SHOWN = 400


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
        Summary, evaluations, history, estimates and reasons, without clock fields, as text: equal
        for equal bits.
    killed : tuple of bool
        Of its runs, whether each failed because its workers died.
    unplotted : int
        Runs that succeeded and whose fitted signals are not stored.
    """

    states: tuple[str, ...]
    doubled: int
    given_up: bool
    figures: str
    killed: tuple[bool, ...]
    unplotted: int

    def list_differences(self, undisturbed: "Finding") -> str:
        """Which figures differ from those, and the first that does in both forms."""
        mine, theirs = json.loads(self.figures), json.loads(undisturbed.figures)
        names = [name for name in mine if mine[name] != theirs[name]]
        differences = {name: f"{mine[name]} instead of {theirs[name]}" for name in names}
        return "; ".join(f"{name}: {text[:SHOWN]}" for name, text in differences.items())

    def count_given_up(self, undisturbed: "Finding") -> int:
        """Runs that were given up, alone or with the job, because they met too many faults."""
        if self.given_up:
            pairs = zip(self.states, undisturbed.states, strict=False)
            return sum(mine != theirs for mine, theirs in pairs)
        killed = zip(self.killed, undisturbed.killed, strict=False)
        return sum(mine and not theirs for mine, theirs in killed)

    def count_lost(self, undisturbed: "Finding") -> int:
        """Runs that did not come to the end they had there."""
        pairs = zip(self.states, undisturbed.states, strict=False)
        missing = max(0, len(undisturbed.states) - len(self.states))
        return missing + sum(mine != theirs for mine, theirs in pairs)


def audit(stand: Stand, job_id: str, *, ends: int = 1) -> Finding:
    """Count what a job has left in the tables, and take its summary over REST.

    Parameters
    ----------
    ends : int
        How often it may have ended: once more than it was resumed.
    """
    with stand.database.read_session() as session:
        job = session.get_one(Job, job_id)
        runs = list(session.scalars(select(Run).where(Run.job_id == job_id).order_by(Run.number)))
        kinds = session.execute(select(Event.kind, Event.data).where(Event.job_id == job_id))
        ended = sum(JobState(data["state"]).is_terminal for kind, data in kinds if kind == "state")
        paths = _paths(session, job_id)
    numbers = Counter(run.number for run in runs)
    doubled = sum(numbers.values()) - len(numbers) + max(0, job.n_done - job.n_runs)
    doubled += max(0, ended - ends)
    summary = remove_clock(stand.client.summary(job_id))
    total = sum(run.evaluations for run in runs)
    estimates, reasons = (
        [run.estimates for run in runs],
        [describe_reason(run.error) for run in runs],
    )
    figures = {
        "summary": summary,
        "evaluations of the job": job.evaluations,
        "of its runs": total,
        "histories": [paths.get(run.id) for run in runs],
        "estimates": estimates,
        "reasons": reasons,
    }
    given_up = job.state is JobState.FAILED and job.lost_leases >= job.max_attempts
    states = tuple(run.state.value for run in runs)
    killed = tuple((run.error or "").startswith(KILLED) for run in runs)
    unplotted = sum(run.state is JobState.SUCCEEDED and run.signals_sha256 is None for run in runs)
    text = json.dumps(figures, sort_keys=True)
    return Finding(states, doubled, given_up, text, killed, unplotted)


def _paths(session: Session, job_id: str) -> dict[str, str]:
    """How each run of a job came to its result, history and migrants, as a hash of all points."""
    mine = Run.job_id == job_id
    parts = select(Run.id, RunHistory.points, RunHistory.n_parameters).join(RunHistory)
    lines = select(Run.id, MigrationLog.migrants).join(MigrationLog)
    points: dict[str, list[tuple[bytes, int]]] = defaultdict(list)
    migrants: dict[str, list[bytes]] = defaultdict(list)
    for run, data, count in session.execute(parts.where(mine)):
        points[run].append((data, count))
    for run, data in session.execute(lines.where(mine)):
        migrants[run].append(data)
    return {
        run: sha256(
            repr([unpack_history("", pages), unpack_migrants("", migrants[run])]).encode()
        ).hexdigest()
        for run, pages in points.items()
    }


def describe_reason(error: str | None) -> str:
    """Why a run failed, without the numbers of processes."""
    return (error or "").split(";")[0]


def remove_clock(document: Any) -> Any:
    """The document without what tells of time and place."""
    if isinstance(document, dict):
        return {k: remove_clock(v) for k, v in document.items() if k not in CLOCKED}
    if isinstance(document, list):
        return [remove_clock(item) for item in document]
    return document


def is_over(stand: Stand, job_id: str) -> bool:
    """Whether a job has ended; False while the database is away."""
    try:
        with stand.database.read_session() as session:
            return session.get_one(Job, job_id).state.is_terminal
    except TRANSIENT_ERRORS:
        return False


def count_steps(stand: Stand, jobs: list[str]) -> int | None:
    """A number that grows with the work on jobs; None while the database is away."""
    try:
        with stand.database.read_session() as session:
            ended = select(func.count()).where(
                Run.job_id.in_(jobs), Run.state == JobState.SUCCEEDED
            )
            return int(session.scalar(ended) or 0)
    except TRANSIENT_ERRORS:
        return None


def list_owners(stand: Stand) -> set[str]:
    """Dispatchers that hold a lease."""
    with stand.database.read_session() as session:
        held = select(Parcel.lease_owner).where(Parcel.lease_owner.is_not(None))
        return {str(owner) for owner in session.scalars(held)}
