"""Turns at what is heavy in the web process: so many requests at once, some more wait, no others.

A simulation of a million samples takes a second of a core and hundreds of megabytes; every request
that waits for its turn holds one of the threads that all others need.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import BoundedSemaphore

from service.core.errors import ServiceBusy

MAX_RUNNING = 2
MAX_WAITING = 16
MAX_WAIT_SECONDS = 20.0


class ConcurrencyLimit:
    """At most `at_once` go on, `waiting` others wait, `seconds` at most."""

    def __init__(
        self,
        at_once: int = MAX_RUNNING,
        waiting: int = MAX_WAITING,
        seconds: float = MAX_WAIT_SECONDS,
    ) -> None:
        self._going, self._seconds = BoundedSemaphore(at_once), seconds
        self._here = BoundedSemaphore(at_once + waiting)

    @contextmanager
    def acquire(self) -> Iterator[None]:
        """A turn, for the length of a block or of a function.

        Raises
        ------
        Busy
            If too many wait already, or it did not come in time.
        """
        if not self._here.acquire(blocking=False):
            raise ServiceBusy("too many simulations are waiting; ask again in a while")
        try:
            if not self._going.acquire(timeout=self._seconds):
                raise ServiceBusy(f"other simulations took {self._seconds:g} s and more; ask again")
            try:
                yield
            finally:
                self._going.release()
        finally:
            self._here.release()


simulation_limit = ConcurrencyLimit()
"""Those of this process."""
