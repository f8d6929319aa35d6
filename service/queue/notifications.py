"""Waiting for work: woken by PostgreSQL, or by a change of the SQLite file, else by the clock.

Questions a dispatcher asks many times a second: cheap reads that lock nothing.
"""

import threading
import time
from abc import ABC, abstractmethod
from typing import NamedTuple, Self, final

import psycopg
from sqlalchemy import bindparam, select
from sqlalchemy.orm import Session

from service.core.states import JobState
from service.queue.admission import Admission
from service.repositories.jobs import QUEUE_CHANNEL
from service.storage.sessions import Database
from service.storage.tables import Job

POLL_SECONDS = 1.0
_FILE_POLL_SECONDS = 0.05


class Notifier(ABC):
    """Waits until there may be work. It may wake in vain, so the caller looks at the queue."""

    @abstractmethod
    def wait_for_change(self, seconds: float = POLL_SECONDS) -> bool:
        """Whether something may have changed, within that time."""

    @abstractmethod
    def close(self) -> None:
        """Free its connection."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


def open_notifier(database: Database, stop: threading.Event | None = None) -> Notifier:
    """A waker for this database, to be used in one thread; `stop` ends a wait at once."""
    stop = stop or threading.Event()
    return (
        _SqliteNotifier(database, stop)
        if database.is_sqlite
        else _PostgresqlNotifier(database, stop)
    )


@final
class _SqliteNotifier(Notifier):
    """Glances at SQLite's count of the changes that other connections have committed."""

    def __init__(self, database: Database, stop: threading.Event) -> None:
        self._stop = stop
        # Not a pooled connection: the pool would give it to writers, whose changes do not count.
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
    """Listens on PostgreSQL's channel; a broken connection is replaced at the next wait."""

    def __init__(self, database: Database, stop: threading.Event) -> None:
        self._database, self._stop = database, stop
        self._connection: psycopg.Connection | None = None

    def wait_for_change(self, seconds: float = POLL_SECONDS) -> bool:
        deadline = time.monotonic() + seconds
        try:
            if self._connection is None:
                self._open_connection()
                return True  # what was queued before it listened was not heard
            return self._wait_for_notification(self._connection, deadline)
        except psycopg.OperationalError:
            self.close()
            return self._stop.wait(max(deadline - time.monotonic(), 0.0))

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _wait_for_notification(self, connection: psycopg.Connection, deadline: float) -> bool:
        while not self._stop.is_set() and (left := deadline - time.monotonic()) > 0:
            heard = connection.notifies(timeout=min(left, 0.2), stop_after=1)
            if any(True for _ in heard):
                return True
        return self._stop.is_set()

    def _open_connection(self) -> None:
        url = self._database.engine.url.set(drivername="postgresql")
        address = url.render_as_string(hide_password=False)
        self._connection = psycopg.connect(address, autocommit=True)
        self._connection.execute(f"LISTEN {QUEUE_CHANNEL}")


# Made once: to make a statement costs more than to carry it out.
# The key, not every column: so the indexes alone answer.
_QUEUED_JOBS = select(Job.id).where(Job.state == JobState.QUEUED)
_CANCELLED_JOBS = select(Job.id).where(
    Job.lease_owner == bindparam("owner"), Job.state == JobState.RUNNING, Job.cancel_requested
)
_ANY_QUEUED = select(_QUEUED_JOBS.exists())


class QueueStatus(NamedTuple):
    """Whether a job waits, and which of a dispatcher's jobs are to be cancelled."""

    has_waiting_job: bool
    jobs_to_cancel: frozenset[str]


def read_queue_status(
    session: Session, owner: str, admission: Admission | None = None
) -> QueueStatus:
    """What a dispatcher should attend to: waiting jobs that `admission` lets in, and cancelled."""
    admitted = (
        _ANY_QUEUED
        if admission is None
        else select(_QUEUED_JOBS.where(admission.admits(Job)).exists())
    )
    is_waiting = session.scalar(admitted)
    asked = session.scalars(_CANCELLED_JOBS, {"owner": owner})
    return QueueStatus(bool(is_waiting), frozenset(asked))
