"""Questions a dispatcher asks many times a second: cheap reads that lock nothing."""

from typing import NamedTuple

from sqlalchemy import bindparam, select
from sqlalchemy.orm import Session

from service.storage.admission import Admission
from service.storage.tables import Job, State

# Made once: to make a statement costs more than to carry it out.
# The key, not every column: so the indexes alone answer.
_QUEUED = select(Job.id).where(Job.state == State.QUEUED)
_ASKED = select(Job.id).where(
    Job.lease_owner == bindparam("owner"), Job.state == State.RUNNING, Job.cancel_requested
)
_ANY = select(_QUEUED.exists())


class Signals(NamedTuple):
    """Whether a job waits, and which of a dispatcher's jobs are to be cancelled."""

    is_waiting: bool
    to_cancel: frozenset[str]


def look(session: Session, owner: str, admission: Admission | None = None) -> Signals:
    """What a dispatcher should attend to: waiting jobs that `admission` lets in, and cancelled."""
    admitted = _ANY if admission is None else select(_QUEUED.where(admission.holds(Job)).exists())
    is_waiting = session.scalar(admitted)
    asked = session.scalars(_ASKED, {"owner": owner})
    return Signals(bool(is_waiting), frozenset(asked))
