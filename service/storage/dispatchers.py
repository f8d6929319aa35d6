"""Which dispatchers are alive."""

from datetime import timedelta

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from service.storage.columns import Document, utc_now
from service.storage.queue import LEASE, Clock
from service.storage.statements import upsert
from service.storage.tables import Dispatcher

_FORGET_AFTER = timedelta(days=1)


class DispatcherRepository:
    """The dispatchers in one session."""

    def __init__(self, session: Session, clock: Clock = utc_now) -> None:
        self._session, self._clock = session, clock

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

    def alive(self, within: timedelta = LEASE) -> list[Dispatcher]:
        """Dispatchers seen within that time, by name."""
        recent = select(Dispatcher).where(Dispatcher.seen_at >= self._clock() - within)
        return list(self._session.scalars(recent.order_by(Dispatcher.owner)))
