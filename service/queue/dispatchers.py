"""Heartbeats of the dispatchers."""

from collections.abc import Iterable, Mapping
from datetime import timedelta
from typing import Literal

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from service.storage.clocks import Clock, choose_database_clock
from service.storage.columns import Document
from service.storage.statements import upsert
from service.storage.tables import DispatcherHeartbeat

_FORGET_AFTER = timedelta(days=1)
_NO_DISPATCHER = (
    "no dispatcher is alive; jobs are accepted, but wait until one starts. A first start compiles "
    "the search, which takes about a minute"
)
_SILENT_DISPATCHER = (
    "no dispatcher is alive: the last heartbeat of {} is {:.0f} s old. It has ended, its main loop "
    "stands, or it does not reach the database. Jobs are accepted, but wait for it"
)
LEASE_SECONDS_KEY = "lease_seconds"
"""Key of the lease length in the details of a dispatcher."""
STARTING_KEY = "starting"
"""Key of what a dispatcher waits for before its first job; absent once it is ready."""


CLUSTER_KEY = "cluster"
"""Key of the identity of a shared Ray cluster, in the same place."""


class DispatcherRepository:
    """The dispatchers in one session."""

    def __init__(self, session: Session, clock: Clock | None = None) -> None:
        self._session, self._clock = session, clock or choose_database_clock(session)

    def add_dispatcher(self, owner: str, details: Document) -> None:
        """Record what a dispatcher tells, and delete those without a heartbeat for a day."""
        now, before = self._clock(), self._session.get(DispatcherHeartbeat, owner)
        row = {
            "owner": owner,
            "details": details,
            "started_at": now if before is None else before.started_at,
            "seen_at": now,
            "wanted_cores": 0,
        }
        upsert(self._session, DispatcherHeartbeat, [row])
        self._session.execute(
            delete(DispatcherHeartbeat).where(DispatcherHeartbeat.seen_at < now - _FORGET_AFTER)
        )

    def record_heartbeat(self, owner: str, wanted_cores: int = 0) -> None:
        """Record a heartbeat of a dispatcher, together with the renewal of its leases."""
        statement = update(DispatcherHeartbeat).where(DispatcherHeartbeat.owner == owner)
        self._session.execute(statement.values(seen_at=self._clock(), wanted_cores=wanted_cores))

    def remove_dispatcher(self, owner: str) -> None:
        """Record that a dispatcher has stopped."""
        self._session.execute(delete(DispatcherHeartbeat).where(DispatcherHeartbeat.owner == owner))

    def list_all(self) -> list[DispatcherHeartbeat]:
        """List every dispatcher that has not stopped, by name."""
        return list(
            self._session.scalars(select(DispatcherHeartbeat).order_by(DispatcherHeartbeat.owner))
        )

    def list_alive(self) -> list[DispatcherHeartbeat]:
        """List the dispatchers with a heartbeat within the length of their leases, by name."""
        now = self._clock()
        return [
            dispatcher
            for dispatcher in self.list_all()
            if dispatcher.seen_at >= now - find_lease_length(dispatcher)
        ]

    def describe_wait(self) -> str | None:
        """Describe why jobs wait for a dispatcher; None if one is alive and ready."""
        starts = [describe_start(one) for one in self.list_alive()]
        if None in starts:
            return None
        if starts:
            return f"{starts[0]}; jobs are accepted, but wait for it"
        latest = max(self.list_all(), key=lambda one: one.seen_at, default=None)
        if latest is None:
            return _NO_DISPATCHER
        age = self._clock() - latest.seen_at
        return _SILENT_DISPATCHER.format(latest.owner, age.total_seconds())


def count_wanted_cores(
    dispatchers: Iterable[DispatcherHeartbeat], cluster: str | None
) -> dict[str, int]:
    """Return the cores that the dispatchers of a cluster have work for, by name."""
    return {
        one.owner: one.wanted_cores
        for one in dispatchers
        if cluster is not None and one.details.get(CLUSTER_KEY) == cluster
    }


def find_lease_length(dispatcher: DispatcherHeartbeat) -> timedelta:
    """Return the length of the leases of a dispatcher."""
    return timedelta(seconds=dispatcher.details[LEASE_SECONDS_KEY])


StartStep = Literal["ray", "search", "workers"]
_STEPS: Mapping[str, str] = {
    "ray": "Ray is starting",
    "search": "the search is compiling",
    "workers": "Ray's workers are starting",
}


def describe_start(dispatcher: DispatcherHeartbeat) -> str | None:
    """Describe what a dispatcher waits for before its first job; None once it is ready."""
    steps = dispatcher.details.get(STARTING_KEY)
    if not steps:
        return None
    seconds = (dispatcher.seen_at - dispatcher.started_at).total_seconds()
    waits = " and ".join(_STEPS.get(step, step) for step in steps)
    return f"a dispatcher is starting ({seconds:.0f} s): {waits}"
