"""Leases of one dispatcher: claimed, renewed, released. Expired ones of others are reaped."""

import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable
from datetime import timedelta
from functools import partial
from importlib.metadata import version

from sqlalchemy.exc import SQLAlchemyError

from service.core.process.loop_watch import LoopWatch
from service.core.process.process_identity import describe_process
from service.dispatch.encoding import describe_program
from service.queue.admission import Admission
from service.queue.daily_limit import stop_overruns
from service.queue.dispatchers import (
    CLUSTER_KEY,
    LEASE_SECONDS_KEY,
    DispatcherRepository,
    count_wanted_cores,
)
from service.queue.leases import Claim, Lease, LeaseQueue, ProgramOfJob, SizeRule
from service.queue.notifications import QueueStatus, read_queue_status
from service.queue.orphaned_jobs import reap_jobs
from service.storage.clocks import Clock
from service.storage.columns import Document
from service.storage.retry import retry_transient
from service.storage.sessions import Database
from service.storage.storage_errors import LeaseLost

_log = logging.getLogger(__name__)

RETRY_SECONDS = 0.5
"""Pause after a heartbeat that could not be written."""


class HeldLeases:
    """Parcels of jobs that this dispatcher may write for.

    A thread renews all leases with one statement, three times within their length. It also reaps
    expired leases of any dispatcher, and stops jobs of projects beyond their evaluations of a day.
    A lease that was not renewed `is_lost`. A forgotten lease is no longer renewed, and expires.
    While a heartbeat waits for the database, the state of a late lease is unknown. Nothing should
    be written under it, but it may still be held.

    The same heartbeat tells for how many cores this dispatcher has work (`wanted_cores`), and reads
    `n_alive`, the number of living dispatchers, and `cores_of_others`, the cores wanted by those
    that have joined the same cluster.

    A heartbeat says that this dispatcher works. So none is sent while its main loop, which `loop`
    watches, has not turned since the last one.

    Parameters
    ----------
    seconds : float
        Length of a lease.
    clock, stopwatch : callable
        The time of day of the rows (by default the database's), and the elapsed seconds of this
        process.
    """

    def __init__(
        self,
        database: Database,
        seconds: float,
        *,
        clock: Clock | None = None,
        stopwatch: Callable[[], float] = time.monotonic,
    ) -> None:
        self.owner = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(3)}"
        self._database, self._length = database, timedelta(seconds=seconds)
        self._clock, self._stopwatch = clock, stopwatch
        self.loop = LoopWatch()
        self._held: dict[Lease, float] = {}  # when each was renewed
        self._has_asked = False  # a claim was sent and not answered
        self.n_alive = 1
        self.wanted_cores = 0
        self.cores_of_others: dict[str, int] = {}
        self._cluster: str | None = None
        self._is_standing = False  # the main loop did not turn before the last heartbeat
        self._is_cut_off = False  # the last heartbeat did not reach the database
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run_heartbeat, name="heartbeat", daemon=True)

    def start_heartbeat(self, details: dict[str, object]) -> None:
        """Register the dispatcher and start the heartbeat; later calls change what it tells."""
        description: Document = {
            LEASE_SECONDS_KEY: self._length.total_seconds(),
            "version": version("lagid"),
            **describe_process(),
            **details,
        }
        self._cluster = description.get(CLUSTER_KEY)
        retry_transient(partial(self._announce_dispatcher, description))
        if not self._thread.is_alive():
            self._thread.start()

    def _announce_dispatcher(self, details: Document) -> None:
        with self._database.write_session() as session:
            dispatchers = DispatcherRepository(session, self._clock)
            dispatchers.add_dispatcher(self.owner, details)
            self._look_at_others(dispatchers)
        reap_jobs(self._database, self._clock)

    def claim_job(
        self,
        admission: Admission | None = None,
        *,
        only: str | None = None,
        choose_size: SizeRule | None = None,
    ) -> Claim | None:
        """Claim a parcel of the next job that `admission` lets in, if one waits.

        Jobs of which a parcel is held are left out, unless one is the `only` one that counts.
        """
        begun = self._stopwatch()
        claim, had_asked = None, self._has_asked
        self._has_asked = True  # a claim may succeed even if its answer is lost
        with self._database.write_session() as session:
            queue = LeaseQueue(session, self._clock)
            if had_asked:
                claim = queue.recover_claim(self.owner, self.list_held())
            if claim is None:
                claim = queue.claim_job(
                    self.owner,
                    self._length,
                    admission,
                    held=self._list_held_jobs(),
                    only=only,
                    choose_size=choose_size,
                    program=ProgramOfJob(**describe_program()),
                )
        self._has_asked = False
        if claim is not None:
            with self._lock:
                self._held[claim.lease] = begun
        return claim

    def check_queue(self, admission: Admission | None = None) -> QueueStatus:
        """Check whether an admissible job waits, and which held jobs are to be cancelled."""
        with self._database.read_session() as session:
            return read_queue_status(session, self.owner, admission, self._list_held_jobs())

    def list_held(self) -> tuple[Lease, ...]:
        """List the leases that are not known to be lost."""
        with self._lock:
            return tuple(self._held)

    def _list_held_jobs(self) -> list[str]:
        return sorted({lease.job_id for lease in self.list_held()})

    def is_lost(self, lease: Lease) -> bool:
        """Test whether the lease is known to be another's, or was forgotten."""
        with self._lock:
            return lease not in self._held

    def is_held(self, lease: Lease) -> bool:
        """Test whether the lease is held, that is, was renewed within its length."""
        with self._lock:
            renewed = self._held.get(lease)
        return renewed is not None and self._stopwatch() - renewed <= self._length.total_seconds()

    def forget_lease(self, lease: Lease) -> None:
        """Stop renewing the lease of a job that has ended or was dropped."""
        with self._lock:
            self._held.pop(lease, None)

    def release_all(self, *, lost: bool = False) -> None:
        """Release every parcel, so that another dispatcher can claim it at once.

        Parameters
        ----------
        lost : bool
            Whether this counts as a lost lease.
        """
        held = self.list_held()
        worked = lost and retry_transient(self._has_worked)
        for lease in held:
            try:
                retry_transient(
                    partial(self._release_lease, lease, lost=lost, others_progressed=worked)
                )
            except LeaseLost:
                _log.info("%s belongs to another dispatcher", lease.job_id)
            self.forget_lease(lease)

    def _release_lease(self, lease: Lease, *, lost: bool, others_progressed: bool) -> None:
        with self._database.write_session() as session:
            LeaseQueue(session, self._clock).release_job(
                lease, lost=lost, others_progressed=others_progressed
            )

    def _has_worked(self) -> bool:
        with self._database.read_session() as session:
            return LeaseQueue(session, self._clock).has_progressed(self.owner)

    def stop_heartbeat(self) -> None:
        """Stop the heartbeat and unregister the dispatcher."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        with self._database.write_session() as session:
            DispatcherRepository(session).remove_dispatcher(self.owner)

    def renew_leases(self) -> None:
        """Send one heartbeat: renew the held leases, reap expired ones, and stop overruns."""
        begun = self._stopwatch()
        before = self.list_held()
        with self._database.write_session(self._heartbeat_seconds) as session:
            dispatchers = DispatcherRepository(session, self._clock)
            dispatchers.record_heartbeat(self.owner, self.wanted_cores)
            renewed = LeaseQueue(session, self._clock).renew_leases(before, self._length)
            self._look_at_others(dispatchers)
        with self._lock:
            for lease in before:
                if lease not in renewed:
                    self._held.pop(lease, None)
                elif lease in self._held:
                    self._held[lease] = begun
        reap_jobs(self._database, self._clock, busy_seconds=self._heartbeat_seconds)
        stop_overruns(self._database, self._heartbeat_seconds)

    def _look_at_others(self, dispatchers: DispatcherRepository) -> None:
        alive = [one for one in dispatchers.list_alive() if one.owner != self.owner]
        self.n_alive = 1 + len(alive)
        self.cores_of_others = count_wanted_cores(alive, self._cluster)

    @property
    def _heartbeat_seconds(self) -> float:
        return self._length.total_seconds() / 3

    def _run_heartbeat(self) -> None:
        third = self._heartbeat_seconds
        pause = third
        while not self._ending.wait(pause):
            pause = third
            if self._tell_standing(third):
                continue
            try:
                self.renew_leases()
                self._is_cut_off = False
            except SQLAlchemyError as error:  # the database may return before the leases end
                if not self._is_cut_off:
                    _log.warning("no heartbeat could be written: %s", str(error).splitlines()[0])
                pause, self._is_cut_off = min(third, RETRY_SECONDS), True

    def _tell_standing(self, limit: float) -> bool:
        """Return whether the main loop stands for longer than `limit` (s); log that it does."""
        stands = self.loop.standing_seconds > limit
        if stands and not self._is_standing:
            _log.warning("no heartbeat is sent, because the main loop stands")
        elif self._is_standing and not stands:
            _log.warning("the main loop turns again")
        self._is_standing = stands
        return stands
