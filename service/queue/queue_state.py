"""Jobs by state over all projects, and the age of the queue: what a service tells its operator."""

from collections.abc import Mapping
from dataclasses import dataclass

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.queue.admission import is_in_state
from service.storage.columns import utc_now
from service.storage.tables import Job, Project


@dataclass(frozen=True, slots=True)
class QueueState:
    """Number of jobs in each state, and seconds since the submission of the oldest queued one."""

    jobs: Mapping[JobState, int]
    oldest_seconds: float


def read_queue_state(session: Session) -> QueueState:
    """Read the state of the queue of all projects."""
    jobs = dict.fromkeys(JobState, 0)
    for project in session.scalars(select(Project.id)):  # the index of jobs begins with it
        of_project = Job.project_id == project, Job.deleted_at.is_(None)
        counts = select(Job.state, func.count()).where(*of_project).group_by(Job.state)
        for state, n in session.execute(counts):
            jobs[state] += n
    # Identifiers sort by time. Only the key is read, so that an index alone can answer.
    oldest = session.scalar(select(func.min(Job.id)).where(is_in_state(JobState.QUEUED)))
    since = session.scalar(select(Job.created_at).where(Job.id == oldest))
    age = 0.0 if since is None else max(0.0, (utc_now() - since).total_seconds())
    return QueueState(jobs, age)
