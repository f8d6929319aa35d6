"""Which dispatchers are alive."""

from datetime import timedelta

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from service.queue.clocks import Clock, clock_of
from service.storage.columns import Document
from service.storage.statements import upsert
from service.storage.tables import Dispatcher

_FORGET_AFTER = timedelta(days=1)
LEASE_SECONDS = "lease_seconds"
"""Under this name a dispatcher tells how long its leases are."""


class DispatcherRepository:
    """The dispatchers in one session."""

    def __init__(self, session: Session, clock: Clock | None = None) -> None:
        self._session, self._clock = session, clock or clock_of(session)

    def announce(self, owner: str, details: Document) -> None:
        """Tell that a dispatcher has started, and forget those long silent."""
        now = self._clock()
        row = {"owner": owner, "details": details, "started_at": now, "seen_at": now}
        upsert(self._session, Dispatcher, [row])
        self._session.execute(delete(Dispatcher).where(Dispatcher.seen_at < now - _FORGET_AFTER))

    def beat(self, owner: str) -> None:
        """Tell that a dispatcher is still there; goes with the heartbeat of its leases."""
        seen = update(Dispatcher).where(Dispatcher.owner == owner)
        self._session.execute(seen.values(seen_at=self._clock()))

    def leave(self, owner: str) -> None:
        """Tell that a dispatcher has stopped."""
        self._session.execute(delete(Dispatcher).where(Dispatcher.owner == owner))

    def all(self) -> list[Dispatcher]:
        """Every dispatcher that has not taken leave, by name."""
        return list(self._session.scalars(select(Dispatcher).order_by(Dispatcher.owner)))

    def alive(self) -> list[Dispatcher]:
        """Dispatchers seen within the length of their leases, by name."""
        now = self._clock()
        return [one for one in self.all() if one.seen_at >= now - length_of(one)]


def length_of(dispatcher: Dispatcher) -> timedelta:
    """How long the leases of a dispatcher are."""
    return timedelta(seconds=dispatcher.details[LEASE_SECONDS])
