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
from service.queue.dispatchers import DispatcherRepository, length_of
from service.queue.leases import HUNG, Owners, Queue, Reaped
from service.storage.sessions import Database

_log = logging.getLogger(__name__)

PAUSE_SECONDS = 1.0
"""Between two looks of the web process."""


def reap(
    database: Database,
    clock: Clock | None = None,
    *,
    busy_seconds: float | None = None,
) -> Reaped:
    """Give back, or end, every job that nobody works on; writes only where there is one.

    Parameters
    ----------
    clock : callable, optional
        By default the database's.
    busy_seconds : float, optional
        How long to wait for the database.
    """
    with database.read() as session:
        known = DispatcherRepository(session, clock).all()
        owners = Owners(
            gone=frozenset(one.owner for one in known if is_gone(one.details)),
            living=frozenset(one.owner for one in known if is_awake(one.details)),
            lengths={one.owner: length_of(one) for one in known},
        )
        if not owners.gone and not Queue(session, clock).has_silent(owners):
            return Reaped()
    with database.write(busy_seconds) as session:
        reaped = Queue(session, clock).reap(owners)
        dispatchers = DispatcherRepository(session, clock)
        for owner in owners.gone:
            dispatchers.leave(owner)
    _tell(reaped, owners)
    return reaped


def _tell(reaped: Reaped, owners: Owners) -> None:
    if not reaped.owners:
        return
    reasons = ", ".join(f"{owner} {_why(owner, owners)}" for owner in sorted(reaped.owners))
    taken = (("queued again", reaped.requeued), ("failed", reaped.failed),
             ("cancelled", reaped.cancelled))  # fmt: skip
    fates = "; ".join(f"{fate}: {', '.join(jobs)}" for fate, jobs in taken if jobs)
    _log.warning("%s; its jobs: %s", reasons, fates)


def _why(owner: str, owners: Owners) -> str:
    if owner in owners.gone:
        return "has ended"
    if owner in owners.living:
        return f"lives, but has not renewed its leases for {HUNG.total_seconds():g} s"
    return "was not heard of within its lease"


class Reaper:
    """Reaps from a thread of its own until `stopping` is set."""

    def __init__(self, database: Database, stopping: threading.Event) -> None:
        self._database, self._stopping = database, stopping
        self._thread = threading.Thread(target=self._go_on, name="reaper", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def join(self) -> None:
        """Wait for the last look to end, once `stopping` is set."""
        self._thread.join(5.0)

    def _go_on(self) -> None:
        is_cut_off = False
        while not self._stopping.wait(PAUSE_SECONDS):
            try:
                reap(self._database)
                is_cut_off = False
            except SQLAlchemyError as error:  # the database may come back
                if not is_cut_off:
                    _log.warning("cannot look for lost jobs: %s", str(error).splitlines()[0])
                is_cut_off = True
