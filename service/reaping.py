"""Jobs whose dispatcher is gone are given back: by every dispatcher, and by the web process.

A lease that has expired tells it of any dispatcher. Of one on this machine its process does, long
before: it is known by boot, PID namespace, number and start, so that no other is taken for it.
"""

import logging
import os
import socket
import threading
from datetime import timedelta
from functools import cache
from pathlib import Path

from sqlalchemy.exc import SQLAlchemyError

from service.storage.columns import Document, utc_now
from service.storage.dispatchers import DispatcherRepository
from service.storage.queue import Clock, Queue, Reaped
from service.storage.sessions import Database
from workers.processes import standing

_log = logging.getLogger(__name__)

PAUSE_SECONDS = 1.0
"""Between two looks of the web process."""


def identity() -> Document:
    """What a dispatcher tells of its process when it announces itself."""
    here = standing(os.getpid())
    return {
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "machine": _machine(),
        "started": None if here is None else here.started,
    }


def is_gone(details: Document) -> bool:
    """Whether a dispatcher is known to have ended; False wherever this process cannot see it."""
    machine, pid, started = (details.get(key) for key in ("machine", "pid", "started"))
    if machine is None or machine != _machine() or not isinstance(pid, int) or started is None:
        return False
    found = standing(pid)
    return found is None or found.is_dead or found.started != started


def reap(database: Database, lease: timedelta, clock: Clock = utc_now) -> Reaped:
    """Give back, or end, every job that nobody works on; writes only where there is one.

    Parameters
    ----------
    lease : timedelta
        How long leases are: one that ends much later was written by a clock since stepped back.
    """
    with database.read() as session:
        known = DispatcherRepository(session, clock).all()
        gone = [one.owner for one in known if is_gone(one.details)]
        if not gone and not Queue(session, clock).has_silent(lease):
            return Reaped()
    with database.write() as session:
        reaped = Queue(session, clock).reap(gone, lease)
        dispatchers = DispatcherRepository(session, clock)
        for owner in gone:
            dispatchers.leave(owner)
    if reaped.requeued or reaped.failed or reaped.cancelled:
        _log.warning("jobs whose dispatcher was gone: %s", reaped)
    return reaped


class Reaper:
    """Reaps from a thread of its own until `stopping` is set."""

    def __init__(self, database: Database, lease: timedelta, stopping: threading.Event) -> None:
        self._database, self._lease, self._stopping = database, lease, stopping
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
                reap(self._database, self._lease)
                is_cut_off = False
            except SQLAlchemyError as error:  # the database may come back
                if not is_cut_off:
                    _log.warning("cannot look for lost jobs: %s", str(error).splitlines()[0])
                is_cut_off = True


@cache
def _machine() -> str | None:
    """Names the boot of this machine and the namespace in which its processes are numbered."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return None
