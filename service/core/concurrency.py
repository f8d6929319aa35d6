"""Turns at what is heavy in the web process: so many requests at once, some more wait, no others.

A simulation of a million samples takes a second of a core and hundreds of megabytes; every request
that waits for its turn holds one of the threads that all others need.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import BoundedSemaphore

from service.core.errors import Busy

AT_ONCE = 2
WAITING = 16
LONGEST_SECONDS = 20.0


class Turns:
    """At most `at_once` go on, `waiting` others wait, `seconds` at most."""

    def __init__(
        self, at_once: int = AT_ONCE, waiting: int = WAITING, seconds: float = LONGEST_SECONDS
    ) -> None:
        self._going, self._seconds = BoundedSemaphore(at_once), seconds
        self._here = BoundedSemaphore(at_once + waiting)

    @contextmanager
    def one(self) -> Iterator[None]:
        """A turn, for the length of a block or of a function.

        Raises
        ------
        Busy
            If too many wait already, or it did not come in time.
        """
        if not self._here.acquire(blocking=False):
            raise Busy("too many simulations are waiting; ask again in a while")
        try:
            if not self._going.acquire(timeout=self._seconds):
                raise Busy(f"other simulations took {self._seconds:g} s and more; ask again")
            try:
                yield
            finally:
                self._going.release()
        finally:
            self._here.release()


simulating = Turns()
"""Those of this process."""
