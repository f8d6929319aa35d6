"""Jobs whose dispatcher is gone are given back: by every dispatcher, and by the web process.

A lease that has expired tells it of any dispatcher. Of one on this machine its process does, long
before: it is known by boot, PID namespace, number and start, so that no other is taken for it. One
that is seen to live and to be awake waits for something, and is not reaped for a while.
"""

import logging
import threading

from sqlalchemy.exc import SQLAlchemyError

from service.core.processes import is_awake, is_gone
from service.queue.clocks import Clock
from service.queue.dispatchers import DispatcherRepository, find_lease_length
from service.queue.leases import HUNG_AFTER, LeaseOwners, LeaseQueue, ReapResult
from service.storage.sessions import Database

_log = logging.getLogger(__name__)

PAUSE_SECONDS = 1.0
"""Between two looks of the web process."""


def reap_jobs(
    database: Database,
    clock: Clock | None = None,
    *,
    busy_seconds: float | None = None,
) -> ReapResult:
    """Give back, or end, every job that nobody works on; writes only where there is one.

    Parameters
    ----------
    clock : callable, optional
        By default the database's.
    busy_seconds : float, optional
        How long to wait for the database.
    """
    with database.read_session() as session:
        known = DispatcherRepository(session, clock).list_all()
        owners = LeaseOwners(
            ended=frozenset(one.owner for one in known if is_gone(one.details)),
            awake=frozenset(one.owner for one in known if is_awake(one.details)),
            lease_lengths={one.owner: find_lease_length(one) for one in known},
        )
        if not owners.ended and not LeaseQueue(session, clock).has_expired(owners):
            return ReapResult()
    with database.write_session(busy_seconds) as session:
        reaped = LeaseQueue(session, clock).reap_expired(owners)
        dispatchers = DispatcherRepository(session, clock)
        for owner in owners.ended:
            dispatchers.remove_dispatcher(owner)
    _log_reaped(reaped, owners)
    return reaped


def _log_reaped(reaped: ReapResult, owners: LeaseOwners) -> None:
    if not reaped.owners:
        return
    reasons = ", ".join(
        f"{owner} {_explain_reaping(owner, owners)}" for owner in sorted(reaped.owners)
    )
    taken = (
        ("queued again", reaped.requeued),
        ("failed", reaped.failed),
        ("cancelled", reaped.cancelled),
    )
    fates = "; ".join(f"{fate}: {', '.join(jobs)}" for fate, jobs in taken if jobs)
    _log.warning("%s; its jobs: %s", reasons, fates)


def _explain_reaping(owner: str, owners: LeaseOwners) -> str:
    if owner in owners.ended:
        return "has ended"
    if owner in owners.awake:
        return f"lives, but has not renewed its leases for {HUNG_AFTER.total_seconds():g} s"
    return "was not heard of within its lease"


class Reaper:
    """Reaps from a thread of its own until `stopping` is set."""

    def __init__(self, database: Database, stopping: threading.Event) -> None:
        self._database, self._stopping = database, stopping
        self._thread = threading.Thread(target=self._run_loop, name="reaper", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def join(self) -> None:
        """Wait for the last look to end, once `stopping` is set."""
        self._thread.join(5.0)

    def _run_loop(self) -> None:
        is_cut_off = False
        while not self._stopping.wait(PAUSE_SECONDS):
            try:
                reap_jobs(self._database)
                is_cut_off = False
            except SQLAlchemyError as error:  # the database may come back
                if not is_cut_off:
                    _log.warning("cannot look for lost jobs: %s", str(error).splitlines()[0])
                is_cut_off = True
