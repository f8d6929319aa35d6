"""Reading of the stored objects now and then, so that damage is found before they are needed."""

import logging
import threading
from datetime import datetime, timedelta

from service.storage.columns import utc_now
from service.storage.garbage import PREFIXES
from service.storage.objects import ObjectStore
from service.storage.storage_errors import ObjectDamaged, ObjectMissing

_log = logging.getLogger(__name__)


class Scrubber:
    """Reads each object once in `days`, one folder of the store after the other.

    The time of day says which folder is due. So a process that starts anew goes on where another
    one was, and nothing is stored about it.

    Parameters
    ----------
    days : float
        0: nothing is read.

    Attributes
    ----------
    n_read : int
        Objects that were read since the start.
    damaged : set of str
        Hashes of objects that were damaged when they were last read.
    """

    def __init__(self, store: ObjectStore, days: float) -> None:
        self._store = store
        self._pace = timedelta(days=days) / len(PREFIXES)
        self._turn: int | None = None  # folders that were due since the epoch, and were read
        self.n_read, self.damaged = 0, set[str]()

    def read_due(self, stopping: threading.Event, now: datetime | None = None) -> None:
        """Read the objects of the folders that are due and were not read; stop when told."""
        if not self._pace:
            return
        now = now or utc_now()
        turn = (now - datetime.fromtimestamp(0, now.tzinfo)) // self._pace
        done = turn - 1 if self._turn is None else self._turn
        for due in range(max(done + 1, turn - len(PREFIXES) + 1), turn + 1):
            for item in self._store.list_objects(PREFIXES[due % len(PREFIXES)]):
                if stopping.is_set():
                    return
                self._read(item.sha256)
            self._turn = due

    def _read(self, sha256: str) -> None:
        self.n_read += 1
        self.damaged.discard(sha256)
        try:
            self._store.check_object(sha256)
        except ObjectDamaged as error:
            self.damaged.add(sha256)
            _log.error("%s", error)
        except ObjectMissing:  # it was deleted meanwhile
            self.n_read -= 1

    def describe(self) -> str:
        """Describe in a line what was read and found."""
        if not self._pace:
            return "not read (LAGID_SCRUB_DAYS)"
        found = f"damaged: {', '.join(sorted(self.damaged))}" if self.damaged else "none damaged"
        return f"{self.n_read} read since the start, {found}"
