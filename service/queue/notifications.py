"""Wait for work: notified by PostgreSQL, by a change of the SQLite file, or by a timeout.

It also answers the questions that a dispatcher asks many times a second, with cheap reads that lock
nothing.
"""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Collection
from typing import TYPE_CHECKING, NamedTuple, Self, final

from sqlalchemy import bindparam, select
from sqlalchemy.orm import Session

from service.queue.admission import Admission, is_open
from service.repositories.job_rows import QUEUE_CHANNEL
from service.storage.sessions import Database
from service.storage.tables import Job, Parcel

if TYPE_CHECKING:
    import psycopg

POLL_SECONDS = 1.0
_FILE_POLL_SECONDS = 0.05
QUIET_SECONDS = 10.0
"""A connection that tells nothing for this time is asked whether it lives."""


class Notifier(ABC):
    """Waits until there may be work. It may wake in vain, so the caller must check the queue."""

    @abstractmethod
    def wait_for_change(self, seconds: float = POLL_SECONDS) -> bool:
        """Wait for a change, at most that long (s); return whether there may be one."""

    @abstractmethod
    def close(self) -> None:
        """Close the connection."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


def open_notifier(database: Database, stop: threading.Event | None = None) -> Notifier:
    """Open a notifier for this database, for use in one thread; `stop` ends a wait at once."""
    stop = stop or threading.Event()
    return (
        _SqliteNotifier(database, stop)
        if database.is_sqlite
        else _PostgresqlNotifier(database, stop)
    )


@final
class _SqliteNotifier(Notifier):
    """Polls SQLite's count of the changes that other connections have committed."""

    def __init__(self, database: Database, stop: threading.Event) -> None:
        self._stop = stop
        # Not a pooled connection: writers would use it too, and its own changes do not count.
        self._connection = database.engine.raw_connection()
        self._connection.detach()
        self._seen = self._read_data_version()

    def wait_for_change(self, seconds: float = POLL_SECONDS) -> bool:
        deadline = time.monotonic() + seconds
        while (version := self._read_data_version()) == self._seen:
            left = deadline - time.monotonic()
            if left <= 0 or self._stop.wait(min(left, _FILE_POLL_SECONDS)):
                return self._stop.is_set()
        self._seen = version
        return True

    def close(self) -> None:
        self._connection.close()

    def _read_data_version(self) -> int:
        cursor = self._connection.cursor()
        try:
            cursor.execute("PRAGMA data_version")
            row = cursor.fetchone()
            return int(row[0]) if row is not None else 0
        finally:
            cursor.close()


@final
class _PostgresqlNotifier(Notifier):
    """Listens on a channel of PostgreSQL; a broken connection is replaced at the next wait."""

    def __init__(self, database: Database, stop: threading.Event) -> None:
        self._database, self._stop = database, stop
        self._connection: psycopg.Connection | None = None
        self._heard_at = 0.0

    def wait_for_change(self, seconds: float = POLL_SECONDS) -> bool:
        from psycopg import OperationalError

        deadline = time.monotonic() + seconds
        try:
            if self._connection is None:
                self._open_connection()
                return True  # jobs queued before it listened were not notified
            return self._wait_for_notification(self._connection, deadline)
        except OperationalError:
            self.close()
            return self._stop.wait(max(deadline - time.monotonic(), 0.0))

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _wait_for_notification(self, connection: "psycopg.Connection", deadline: float) -> bool:
        while not self._stop.is_set() and (left := deadline - time.monotonic()) > 0:
            notifications = connection.notifies(timeout=min(left, 0.2), stop_after=1)
            if any(True for _ in notifications):
                self._heard_at = time.monotonic()
                return True
        if time.monotonic() - self._heard_at > QUIET_SECONDS:
            connection.execute("SELECT 1")
            self._heard_at = time.monotonic()
        return self._stop.is_set()

    def _open_connection(self) -> None:
        from service.storage.postgresql import open_connection

        self._connection = open_connection(self._database.engine)
        self._connection.execute(f"LISTEN {QUEUE_CHANNEL}")
        self._heard_at = time.monotonic()


# Built once: building a statement costs more than executing it.
_WAITING_PARCELS = (
    select(Parcel.job_id)
    .join(Job, Job.id == Parcel.job_id)
    .where(Parcel.lease_owner.is_(None), is_open(), ~Job.cancel_requested)
)
_CANCELLED_JOBS = (
    select(Job.id)
    .join(Parcel, Parcel.job_id == Job.id)
    .where(Parcel.lease_owner == bindparam("owner"), is_open(), Job.cancel_requested)
)
_OF_THESE = Parcel.job_id.in_(bindparam("jobs", expanding=True))
_ANY_WAITING = select(_WAITING_PARCELS.exists())
_ANY_OTHER_WAITING = select(_WAITING_PARCELS.where(~_OF_THESE).exists())
_HELD_WAITING = _WAITING_PARCELS.where(_OF_THESE).distinct()


class QueueStatus(NamedTuple):
    """What waits for a dispatcher.

    Attributes
    ----------
    has_waiting_job : bool
        Whether a job that it does not hold has a parcel for it.
    jobs_to_cancel : frozenset of str
        Jobs that it holds and that are to be cancelled.
    jobs_to_extend : frozenset of str
        Jobs that it holds and that have another parcel for it.
    """

    has_waiting_job: bool
    jobs_to_cancel: frozenset[str]
    jobs_to_extend: frozenset[str] = frozenset()


def read_queue_status(
    session: Session,
    owner: str,
    admission: Admission | None = None,
    held: Collection[str] = (),
) -> QueueStatus:
    """Read whether `admission` accepts a waiting job, and what becomes of the `held` ones."""
    jobs = {"jobs": list(held)}
    if admission is not None:
        query = _WAITING_PARCELS.where(~_OF_THESE, admission.admits(Job))
        is_waiting = session.scalar(select(query.exists()), jobs)
    elif held:
        is_waiting = session.scalar(_ANY_OTHER_WAITING, jobs)
    else:
        is_waiting = session.scalar(_ANY_WAITING)
    cancelled = session.scalars(_CANCELLED_JOBS, {"owner": owner})
    to_extend = session.scalars(_HELD_WAITING, jobs) if held else ()
    return QueueStatus(bool(is_waiting), frozenset(cancelled), frozenset(to_extend))
