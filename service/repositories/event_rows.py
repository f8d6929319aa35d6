"""The events of jobs in order: the source of the event stream."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from service.core.states import OPEN_STATES
from service.storage.columns import Document
from service.storage.tables import TOLD_CONDITION, Event, Job

EventKind = Literal["state", "progress", "log", "end"]


@dataclass(frozen=True, slots=True)
class JobHead:
    """The number of a job's last event (0 if there is none), and whether the job has ended."""

    last: int
    is_over: bool


class EventRepository:
    """The events in one session.

    An event is added only while the same transaction locks the row of its job. So the events of a
    job become visible in the order of their numbers. A reader that asks for all events after the
    last one misses none.
    """

    def __init__(self, session: Session) -> None:
        self._session = session

    def append_event(self, job_id: str, kind: EventKind, data: Document) -> Event:
        """Add an event to a job."""
        self._session.execute(
            select(Job.id).where(Job.id == job_id).with_for_update(key_share=True)
        )
        event = Event(job_id=job_id, kind=kind, data=data)
        self._session.add(event)
        self._session.flush()
        return event

    def append_state(self, job: Job) -> None:
        """Append the new state of a job, and the end of its events if the state is terminal."""
        data = {"state": job.state.value, "attempt": job.attempt, "error": job.error}
        self.append_event(job.id, "state", data)
        if job.state not in OPEN_STATES:
            self.append_event(job.id, "end", data)

    def list_after(self, job_id: str, last_id: int = 0, limit: int = 500) -> list[Event]:
        """List the events of a job after number `last_id`, oldest first."""
        newer = select(Event).where(Event.job_id == job_id, Event.id > last_id)
        return list(self._session.scalars(newer.order_by(Event.id).limit(limit)))

    def read_heads(self, job_ids: Collection[str]) -> dict[str, JobHead]:
        """Read how far the events of these jobs are."""
        last = select(func.max(Event.id)).where(Event.job_id == Job.id).scalar_subquery()
        rows = self._session.execute(select(Job.id, Job.state, last).where(Job.id.in_(job_ids)))
        return {job_id: JobHead(number or 0, state.is_terminal) for job_id, state, number in rows}

    def list_latest(self, job_id: str, limit: int = 100) -> list[Event]:
        """List the last events of a job that are no progress, oldest first."""
        told = select(Event).where(Event.job_id == job_id, text(TOLD_CONDITION))
        return list(self._session.scalars(told.order_by(Event.id.desc()).limit(limit)))[::-1]
