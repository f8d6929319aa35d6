"""Admission of jobs: those that a dispatcher claims, and those that a project may submit."""

from dataclasses import dataclass

from sqlalchemy import ColumnElement, Subquery, func, or_, select
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


@dataclass(frozen=True, slots=True)
class UnfinishedWork:
    """Queued and running jobs of a project, and their unfinished runs."""

    jobs: int
    runs: int


def count_unfinished(session: Session, project_id: str) -> UnfinishedWork:
    """Count the unfinished jobs and runs of a project."""
    query = select(func.count(), func.coalesce(func.sum(Job.n_runs - Job.n_done), 0)).where(
        Job.state.in_(OPEN_STATES), Job.project_id == project_id
    )
    jobs, runs = session.execute(query).one()
    return UnfinishedWork(int(jobs), int(runs))


def count_running_jobs() -> Subquery:
    """Count the running jobs of each project; the project with the fewest is next.

    Columns ``project_id`` and ``n``. A project without running jobs is not among them.
    """
    count = func.count().label("n")
    running = select(Job.project_id, count).where(Job.state == JobState.RUNNING)
    return running.group_by(Job.project_id).subquery("in_hand")
