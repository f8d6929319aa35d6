"""Housekeeping of the web process: retention, removal of deleted rows and objects, scrubbing."""

import logging
import threading
import time
from dataclasses import dataclass

from sqlalchemy.exc import SQLAlchemyError

from service.storage.garbage import delete_orphans
from service.storage.objects import ObjectStore
from service.storage.sessions import Database
from service.storage.storage_errors import StorageError
from service.upkeep.retention import (
    delete_expired_actions,
    delete_expired_jobs,
    purge_deleted_jobs,
)
from service.upkeep.scrubber import Scrubber

_log = logging.getLogger(__name__)

FIRST_PAUSE_SECONDS = 60.0
"""Pause after the start, so that a service that starts is not slowed."""
PAUSE_SECONDS = 600.0
COLLECT_SECONDS = 3600.0
"""Pause between two collections of objects, which list the whole store."""


@dataclass(frozen=True, slots=True)
class KeptDays:
    """How many days things are kept; None: for ever.

    Attributes
    ----------
    jobs : float or None
        Ended jobs, in projects without a rule of their own.
    audit : float or None
        Entries of the audit log.
    """

    jobs: float | None = None
    audit: float | None = None


class Housekeeper:
    """Keeps the data in order in a separate thread until `stopping` is set."""

    def __init__(
        self,
        database: Database,
        store: ObjectStore,
        keep: KeptDays,
        stopping: threading.Event,
        scrubber: Scrubber,
    ) -> None:
        self._database, self._store, self._keep = database, store, keep
        self._scrubber = scrubber
        self._stopping = stopping
        self._collected_at = time.monotonic()
        self._thread = threading.Thread(target=self._run_loop, name="housekeeper", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def join(self) -> None:
        """Wait for the present pass to end, once `stopping` is set."""
        self._thread.join(5.0)

    def run_pass(self) -> None:
        """Delete what has expired, remove the rows of deleted jobs, and then their objects.

        At the end some of the other objects are read, to find damage.
        """
        deleted = delete_expired_jobs(self._database, self._keep.jobs)
        if deleted:
            _log.info("retention deleted %s", ", ".join(deleted))
        n_entries = delete_expired_actions(self._database, self._keep.audit)
        if n_entries:
            _log.info("retention deleted %d entries of the audit log", n_entries)
        purge_deleted_jobs(self._database)
        # Deleted recordings and refused uploads leave objects too, also of an earlier process.
        if time.monotonic() - self._collected_at > COLLECT_SECONDS:
            n_objects, n_bytes = delete_orphans(self._database, self._store)
            if n_objects:
                _log.info("removed %d objects, %d bytes", n_objects, n_bytes)
            self._collected_at = time.monotonic()
        self._scrubber.read_due(self._stopping)

    def _run_loop(self) -> None:
        pause = FIRST_PAUSE_SECONDS
        while not self._stopping.wait(pause):
            pause = PAUSE_SECONDS
            try:
                self.run_pass()
            except (SQLAlchemyError, StorageError) as error:  # tried again at the next pass
                _log.warning("housekeeping failed: %s", str(error).splitlines()[0])
