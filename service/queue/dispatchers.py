"""Which dispatchers are alive."""

from datetime import timedelta

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from service.queue.clocks import Clock, choose_database_clock
from service.storage.columns import Document
from service.storage.statements import upsert
from service.storage.tables import DispatcherHeartbeat

_FORGET_AFTER = timedelta(days=1)
LEASE_SECONDS_KEY = "lease_seconds"
"""Under this name a dispatcher tells how long its leases are."""


class DispatcherRepository:
    """The dispatchers in one session."""

    def __init__(self, session: Session, clock: Clock | None = None) -> None:
        self._session, self._clock = session, clock or choose_database_clock(session)

    def add_dispatcher(self, owner: str, details: Document) -> None:
        """Tell that a dispatcher has started, and forget those long silent."""
        now = self._clock()
        row = {"owner": owner, "details": details, "started_at": now, "seen_at": now}
        upsert(self._session, DispatcherHeartbeat, [row])
        self._session.execute(
            delete(DispatcherHeartbeat).where(DispatcherHeartbeat.seen_at < now - _FORGET_AFTER)
        )

    def record_heartbeat(self, owner: str) -> None:
        """Tell that a dispatcher is still there; goes with the heartbeat of its leases."""
        seen = update(DispatcherHeartbeat).where(DispatcherHeartbeat.owner == owner)
        self._session.execute(seen.values(seen_at=self._clock()))

    def remove_dispatcher(self, owner: str) -> None:
        """Tell that a dispatcher has stopped."""
        self._session.execute(delete(DispatcherHeartbeat).where(DispatcherHeartbeat.owner == owner))

    def list_all(self) -> list[DispatcherHeartbeat]:
        """Every dispatcher that has not taken leave, by name."""
        return list(
            self._session.scalars(select(DispatcherHeartbeat).order_by(DispatcherHeartbeat.owner))
        )

    def list_alive(self) -> list[DispatcherHeartbeat]:
        """Dispatchers seen within the length of their leases, by name."""
        now = self._clock()
        return [one for one in self.list_all() if one.seen_at >= now - find_lease_length(one)]


def find_lease_length(dispatcher: DispatcherHeartbeat) -> timedelta:
    """How long the leases of a dispatcher are."""
    return timedelta(seconds=dispatcher.details[LEASE_SECONDS_KEY])
