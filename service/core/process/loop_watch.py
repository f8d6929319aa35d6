"""Whether a main loop turns, or stands in a call that does not return.

A process that lives is not one that works. So whoever speaks for a loop, such as a thread that
sends heartbeats, asks here first.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_of_thread = threading.local()


class LoopWatch:
    """What is known of one loop. It is watched from its first turn until `end`.

    Parameters
    ----------
    stopwatch : callable
        Elapsed seconds.
    """

    def __init__(self, stopwatch: Callable[[], float] = time.monotonic) -> None:
        self._stopwatch = stopwatch
        self._late_at: float | None = None  # from then on it stands

    @property
    def standing_seconds(self) -> float:
        """How long the loop has not turned; 0 within a step that was allowed to be long."""
        late_at = self._late_at
        return 0.0 if late_at is None else max(0.0, self._stopwatch() - late_at)

    def turn(self) -> None:
        """Tell that the loop turns; it belongs to the thread that says so."""
        _of_thread.watch = self
        self._late_at = self._stopwatch()

    def end(self) -> None:
        """Tell that the loop has ended."""
        self._late_at = None


def report_turn() -> None:
    """Tell that the loop of this thread, if it has one, waits for something that may come."""
    watch: LoopWatch | None = getattr(_of_thread, "watch", None)
    if watch is not None:
        watch.turn()


@contextmanager
def allow_long_step(seconds: float) -> Iterator[None]:
    """Let the loop of this thread, if it has one, stand for `seconds` until the block ends."""
    watch: LoopWatch | None = getattr(_of_thread, "watch", None)
    if watch is None:
        yield
        return
    watch._late_at = watch._stopwatch() + seconds
    try:
        yield
    finally:
        watch.turn()
