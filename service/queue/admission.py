"""Admission of jobs: those that a dispatcher claims, and those that a project may submit."""

from dataclasses import dataclass
from typing import Any

from sqlalchemy import BindParameter, ColumnElement, Subquery, bindparam, func, or_, select
from sqlalchemy.orm import Session

from service.core.states import OPEN_STATES, JobState
from service.storage.tables import Job


@dataclass(frozen=True, slots=True)
class Admission:
    """Jobs that a busy dispatcher still claims: short ones, and more urgent ones.

    Attributes
    ----------
    max_runs : int
        A job with at most this many runs is short.
    above_priority : int
        A job of a higher priority is urgent.
    """

    max_runs: int
    above_priority: int

    def admits(self, job: type[Job]) -> ColumnElement[bool]:
        """Return the condition that a row of `jobs` is admitted."""
        return or_(job.n_runs <= self.max_runs, job.priority > self.above_priority)


def is_open(job: type[Job] = Job) -> ColumnElement[bool]:
    """Return the condition that a row of `jobs` is queued or running.

    Its values are written out: SQLite then sees that the index of open jobs has all such rows.
    """
    states: BindParameter[Any] = bindparam(None, OPEN_STATES, expanding=True, literal_execute=True)
    condition: ColumnElement[bool] = job.state.in_(states)
    return condition


def is_in_state(state: JobState, job: type[Job] = Job) -> ColumnElement[bool]:
    """Return the condition that a row of `jobs` is in this open state, found by the same index."""
    return is_open(job) & (job.state == state)


@dataclass(frozen=True, slots=True)
class UnfinishedWork:
    """Queued and running jobs of a project, and their unfinished runs."""

    jobs: int
    runs: int


def count_unfinished(session: Session, project_id: str) -> UnfinishedWork:
    """Count the unfinished jobs and runs of a project."""
    counts = func.count(), func.sum(Job.n_runs - Job.n_done)
    # Of all projects: with a condition on one, SQLite may search all jobs that it ever had.
    query = select(Job.project_id, *counts).where(is_open()).group_by(Job.project_id)
    for project, jobs, runs in session.execute(query):
        if project == project_id:
            return UnfinishedWork(int(jobs), int(runs))
    return UnfinishedWork(0, 0)


def count_running_jobs() -> Subquery:
    """Count the running jobs of each project; the project with the fewest is next.

    Columns ``project_id`` and ``n``. A project without running jobs is not among them.
    """
    count = func.count().label("n")
    running = select(Job.project_id, count).where(is_in_state(JobState.RUNNING))
    return running.group_by(Job.project_id).subquery("in_hand")
