"""Storage of fitted signals that workers have encoded."""

import time
from weakref import WeakSet

from service.core.process.loop_watch import allow_long_step
from service.storage.objects import ObjectStore
from service.storage.storage_errors import ObjectStoreFailed

RETRY_SECONDS = 15.0
"""Longest wait for a store that accepts nothing, such as a full disk."""
RETRY_PAUSE_SECONDS = 0.3
STORE_SECONDS = 120.0
"""Time in which a store answers, though with an error: a request to a bucket has its own limits."""
_unavailable_stores: "WeakSet[ObjectStore]" = WeakSet()
"""Stores that timed out."""


def store_signals(store: ObjectStore, signals: bytes) -> str:
    """Store signals in one object, and return its name.

    A store that is full or unavailable is tried again for a while. After a time-out it is tried
    once only, until it has accepted an object. This holds for all jobs of the dispatcher, because
    all of them would wait.

    Raises
    ------
    ObjectStoreFailed
        If it does not accept them in time.
    """
    begun = time.monotonic()
    while True:
        try:
            with allow_long_step(STORE_SECONDS):
                sha256 = store.put_stream([signals]).sha256
        except ObjectStoreFailed:
            if store in _unavailable_stores or time.monotonic() - begun > RETRY_SECONDS:
                _unavailable_stores.add(store)
                raise
            time.sleep(RETRY_PAUSE_SECONDS)
        else:
            _unavailable_stores.discard(store)
            return sha256
