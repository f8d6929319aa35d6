"""The leases of one dispatcher: claimed, kept alive, given back; and those of dead ones reaped."""

import logging
import os
import secrets
import socket
import threading
import time
from datetime import timedelta

from sqlalchemy.exc import SQLAlchemyError

from service.storage.dispatchers import DispatcherRepository
from service.storage.errors import LeaseLost
from service.storage.queue import Claim, Lease, Queue
from service.storage.sessions import Database
from service.storage.watch import Signals, look

_log = logging.getLogger(__name__)


class Leases:
    """The jobs this dispatcher may write for.

    A thread renews all leases with one statement, three times within their length, and reaps the
    expired leases of others. A lease that did not come back is `is_lost` at once.
    """

    def __init__(self, database: Database, seconds: float) -> None:
        self.owner = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(3)}"
        self._database, self._length = database, timedelta(seconds=seconds)
        self._held: dict[str, Lease] = {}
        self._lost: set[Lease] = set()
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._renewed = time.monotonic()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def start(self, details: dict[str, object]) -> None:
        """Announce the dispatcher and begin to beat."""
        with self._database.write() as session:
            DispatcherRepository(session).announce(self.owner, dict(details))
            Queue(session).reap()
        self._thread.start()

    def claim(self) -> Claim | None:
        """Take the next job, if one waits."""
        with self._database.write() as session:
            claim = Queue(session).claim(self.owner, self._length)
        if claim is not None:
            with self._lock:
                self._held[claim.lease.job_id] = claim.lease
        return claim

    def look(self) -> Signals:
        """Whether a job waits, and which of ours are to be cancelled."""
        with self._database.read() as session:
            return look(session, self.owner)

    def is_lost(self, lease: Lease) -> bool:
        """Whether the lease is known to be lost, or was not renewed in time."""
        late = time.monotonic() - self._renewed > self._length.total_seconds()
        with self._lock:
            return late or lease in self._lost

    def forget(self, lease: Lease) -> None:
        """The job has ended, or is another's: renew it no longer."""
        with self._lock:
            self._held.pop(lease.job_id, None)
            self._lost.discard(lease)

    def release_all(self) -> None:
        """Give every job back, so that another dispatcher has it at once."""
        with self._lock:
            held = tuple(self._held.values())
        for lease in held:
            try:
                with self._database.write() as session:
                    Queue(session).release(lease)
            except LeaseLost:
                _log.info("%s was no longer ours", lease.job_id)
            self.forget(lease)

    def stop(self) -> None:
        """Stop beating and take leave."""
        self._ending.set()
        self._thread.join(5.0)
        with self._database.write() as session:
            DispatcherRepository(session).leave(self.owner)

    def _beat(self) -> None:
        pause = self._length.total_seconds() / 3
        while not self._ending.wait(pause):
            try:
                self._renew()
            except SQLAlchemyError:  # an unreachable database may come back before the lease ends
                _log.exception("no heartbeat could be written")

    def _renew(self) -> None:
        begun = time.monotonic()
        with self._lock:
            before = dict(self._held)
        with self._database.write() as session:
            DispatcherRepository(session).beat(self.owner)
            renewed = {held.lease for held in Queue(session).heartbeat(self.owner, self._length)}
            reaped = Queue(session).reap()
        self._renewed = begun
        with self._lock:
            still = set(self._held.values())
            self._lost |= {one for one in before.values() if one not in renewed and one in still}
        if reaped.requeued or reaped.failed or reaped.cancelled:
            _log.warning("leases of silent dispatchers: %s", reaped)
