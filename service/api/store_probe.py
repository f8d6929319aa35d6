"""Probe whether objects can be written, without a write for each request that asks."""

import logging
import time
from threading import Lock

from service.storage.objects import ObjectStore
from service.storage.storage_errors import ObjectStoreFailed

_log = logging.getLogger(__name__)

PROBE_SECONDS = 5.0
"""How long the outcome of a probe holds."""


class StoreProbe:
    """Whether objects can be written, tried at most once in `PROBE_SECONDS`."""

    def __init__(self, store: ObjectStore) -> None:
        self._store, self._lock = store, Lock()
        self._is_writable, self._tried_at = False, -PROBE_SECONDS

    def is_writable(self) -> bool:
        """Return whether objects can be written now, or could a moment ago."""
        with self._lock:
            if time.monotonic() - self._tried_at >= PROBE_SECONDS:
                self._is_writable = self._try_to_write()
                self._tried_at = time.monotonic()
            return self._is_writable

    def _try_to_write(self) -> bool:
        try:
            self._store.check_writable()
        except ObjectStoreFailed as error:
            _log.warning("%s", error)
            return False
        return True
