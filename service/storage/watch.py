"""Questions a dispatcher asks many times a second: cheap reads that lock nothing."""

from typing import NamedTuple

from sqlalchemy import select, true
from sqlalchemy.orm import Session

from service.storage.admission import Admission
from service.storage.tables import Job, State


class Signals(NamedTuple):
    """Whether a job waits, and which of a dispatcher's jobs are to be cancelled."""

    is_waiting: bool
    to_cancel: frozenset[str]


def look(session: Session, owner: str, admission: Admission | None = None) -> Signals:
    """What a dispatcher should attend to: waiting jobs that `admission` lets in, and cancelled."""
    admitted = true() if admission is None else admission.holds(Job)
    # The key, not every column: so the index alone answers.
    queued = select(Job.id).where(Job.state == State.QUEUED, admitted)
    waiting = session.scalar(select(queued.exists()))
    asked = select(Job.id).where(
        Job.lease_owner == owner, Job.state == State.RUNNING, Job.cancel_requested
    )
    return Signals(bool(waiting), frozenset(session.scalars(asked)))
