"""Give back the jobs of dead dispatchers; every dispatcher and the web process do this.

An expired lease reveals any dead dispatcher. On this machine the process reveals it much earlier. A
process is identified by boot, PID namespace, number and start, so that no other is mistaken for it.
A process that is alive and awake waits for something, and is not reaped for a while.
"""

import logging
import threading

from sqlalchemy.exc import SQLAlchemyError

from service.core.process import service_metrics
from service.core.process.process_identity import is_awake, is_gone
from service.queue.dispatchers import DispatcherRepository, find_lease_length
from service.queue.leases import HUNG_AFTER, LeaseOwners, LeaseQueue, ReapResult
from service.storage.clocks import Clock
from service.storage.sessions import Database

_log = logging.getLogger(__name__)

PAUSE_SECONDS = 1.0
"""Pause in s between two checks of the web process."""


def reap_jobs(
    database: Database,
    clock: Clock | None = None,
    *,
    busy_seconds: float | None = None,
) -> ReapResult:
    """Give back or end every orphaned job; write only if there is one.

    Parameters
    ----------
    clock : callable, optional
        By default that of the database.
    busy_seconds : float, optional
        How long to wait for a lock of the database.
    """
    with database.read_session() as session:
        rows = DispatcherRepository(session, clock).list_all()
        owners = LeaseOwners(
            ended=frozenset(row.owner for row in rows if is_gone(row.details)),
            awake=frozenset(row.owner for row in rows if is_awake(row.details)),
            lease_lengths={row.owner: find_lease_length(row) for row in rows},
        )
        if not owners.ended and not LeaseQueue(session, clock).has_expired(owners):
            return ReapResult()
    with database.write_session(busy_seconds) as session:
        reaped = LeaseQueue(session, clock).reap_expired(owners)
        dispatchers = DispatcherRepository(session, clock)
        for owner in owners.ended:
            dispatchers.remove_dispatcher(owner)
    _report_reaped(reaped, owners)
    return reaped


def _report_reaped(reaped: ReapResult, owners: LeaseOwners) -> None:
    if not reaped.owners:
        return
    service_metrics.lease_losses.labels("reaper").inc(
        len(reaped.requeued) + len(reaped.failed) + len(reaped.cancelled)
    )
    reasons = ", ".join(
        f"{owner} {_explain_reaping(owner, owners)}" for owner in sorted(reaped.owners)
    )
    jobs_by_fate = (
        ("queued again", reaped.requeued),
        ("failed", reaped.failed),
        ("cancelled", reaped.cancelled),
    )
    fates = "; ".join(f"{fate}: {', '.join(jobs)}" for fate, jobs in jobs_by_fate if jobs)
    _log.warning("%s; its jobs: %s", reasons, fates)


def _explain_reaping(owner: str, owners: LeaseOwners) -> str:
    if owner in owners.ended:
        return "has ended"
    if owner in owners.awake:
        return f"lives, but has not renewed its leases for {HUNG_AFTER.total_seconds():g} s"
    return "sent no heartbeat within its lease"


class Reaper:
    """Reaps in a separate thread until `stopping` is set."""

    def __init__(self, database: Database, stopping: threading.Event) -> None:
        self._database, self._stopping = database, stopping
        self._thread = threading.Thread(target=self._run_loop, name="reaper", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def join(self) -> None:
        """Wait for the last check to end, once `stopping` is set."""
        self._thread.join(5.0)

    def _run_loop(self) -> None:
        is_logged = False
        while not self._stopping.wait(PAUSE_SECONDS):
            try:
                reap_jobs(self._database)
                is_logged = False
            except SQLAlchemyError as error:  # the database may come back
                if not is_logged:
                    _log.warning("cannot check for orphaned jobs: %s", str(error).splitlines()[0])
                is_logged = True
