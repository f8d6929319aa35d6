"""Concurrency limits for heavy requests: some run, some wait, all others get 503.

A simulation of a million samples takes a second of a core and hundreds of megabytes. Every request
that waits holds one of the threads that all others need.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import BoundedSemaphore

from service.core.errors import ServiceBusy

MAX_RUNNING = 2
MAX_WAITING = 16
MAX_WAIT_SECONDS = 20.0


class ConcurrencyLimit:
    """Limit of `at_once` running and `waiting` queued calls; a call waits for `seconds` at most."""

    def __init__(
        self,
        at_once: int = MAX_RUNNING,
        waiting: int = MAX_WAITING,
        seconds: float = MAX_WAIT_SECONDS,
    ) -> None:
        self._running, self._seconds = BoundedSemaphore(at_once), seconds
        self._admitted = BoundedSemaphore(at_once + waiting)

    @contextmanager
    def acquire(self) -> Iterator[None]:
        """Hold a slot for the length of a block or of a function.

        Raises
        ------
        ServiceBusy
            If too many calls wait already, or no slot became free in time.
        """
        if not self._admitted.acquire(blocking=False):
            raise ServiceBusy("too many simulations are waiting; ask again in a few seconds")
        try:
            if not self._running.acquire(timeout=self._seconds):
                raise ServiceBusy(
                    f"no simulation slot became free within {self._seconds:g} s; ask again"
                )
            try:
                yield
            finally:
                self._running.release()
        finally:
            self._admitted.release()


simulation_limit = ConcurrencyLimit()
"""Limit of this process for simulations."""
