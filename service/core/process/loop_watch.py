"""Whether a main loop turns, or stands in a call that does not return.

A process that lives is not one that works. So whoever speaks for a loop, such as a thread that
sends heartbeats, asks here first. Time counts only while the process could run: a suspended machine
ends nobody (`sysid.core.awake_clock`).
"""

import faulthandler
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from service.core.process.outer_watch import OuterWatch
from sysid.core.awake_clock import read_awake_seconds

_log = logging.getLogger(__name__)

STANDS_SECONDS = 60.0
"""A loop that stands for this time does not return. Each wait has a limit that is shorter."""
LOOK_SECONDS = 1.0

_of_thread = threading.local()


class LoopWatch:
    """What is known of one loop. It is watched from its first turn until `end`.

    Parameters
    ----------
    stopwatch : callable
        Elapsed seconds of this process.
    """

    def __init__(self, stopwatch: Callable[[], float] = read_awake_seconds) -> None:
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


def end_if_standing(
    loop: LoopWatch,
    stopping: threading.Event,
    end: Callable[[], None],
    look: Callable[[], None] = lambda: None,
) -> None:
    """Watch a loop in a thread until `stopping`, and call `end` if it stands.

    Whoever started the process starts it anew. The log gets the stack of each thread. Native code
    may keep even the watching thread from running. Then a child of the process ends it.

    Parameters
    ----------
    look : callable
        Is called every second.
    """
    faulthandler.enable()  # the stacks of a process that the outer watch ends
    outer = OuterWatch(2 * STANDS_SECONDS)

    def watch() -> None:
        while not stopping.wait(LOOK_SECONDS):
            outer.speak()
            look()
            if loop.standing_seconds > STANDS_SECONDS:
                _log.error("the main loop stands for %g s. What it does follows", STANDS_SECONDS)
                faulthandler.dump_traceback()
                end()
        outer.close()

    threading.Thread(target=watch, name="watch", daemon=True).start()
