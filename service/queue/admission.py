"""Which jobs get in: those that a dispatcher takes, and those that a project may still submit."""

from dataclasses import dataclass

from sqlalchemy import ColumnElement, Subquery, func, or_, select
from sqlalchemy.orm import Session

from service.core.states import OPEN_STATES, JobState
from service.storage.tables import Job


@dataclass(frozen=True, slots=True)
class Admission:
    """What a dispatcher that has its hands full still takes: short jobs, and more urgent ones.

    Attributes
    ----------
    most_runs : int
        A job of so many runs is short.
    above : int
        A job of a higher priority is urgent.
    """

    max_runs: int
    above_priority: int

    def admits(self, job: type[Job]) -> ColumnElement[bool]:
        """Condition that a row of `jobs` gets in."""
        return or_(job.n_runs <= self.max_runs, job.priority > self.above_priority)


@dataclass(frozen=True, slots=True)
class UnfinishedWork:
    """Jobs of a project that wait or run, and their runs that are not done."""

    jobs: int
    runs: int


def count_unfinished(session: Session, project_id: str) -> UnfinishedWork:
    """What a project has queued or running."""
    query = select(func.count(), func.coalesce(func.sum(Job.n_runs - Job.n_done), 0)).where(
        Job.state.in_(OPEN_STATES), Job.project_id == project_id
    )
    jobs, runs = session.execute(query).one()
    return UnfinishedWork(int(jobs), int(runs))


def count_running_jobs() -> Subquery:
    """How many jobs of each project dispatchers have in hand, counted once: who has fewest is next.

    Columns ``project_id`` and ``n``; a project that has none is not among them.
    """
    count = func.count().label("n")
    running = select(Job.project_id, count).where(Job.state == JobState.RUNNING)
    return running.group_by(Job.project_id).subquery("in_hand")
