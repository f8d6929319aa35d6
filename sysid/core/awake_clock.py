"""Elapsed time of this process, without the time in which it could not run.

A snapshot of a virtual machine, the sleep of a laptop, and SIGSTOP stop all threads, while the
clocks of the system go on. Whoever ends what "did not answer for a minute" must not count that
time, for nobody could have answered. So a thread takes short naps, and each nap counts at most its
own length. On a machine that is too busy to wake the thread, this clock is slow as well.
"""

import threading
import time
from collections.abc import Callable

NAP_SECONDS = 1.0
"""Length of a nap: so much of a standstill counts at most."""


class AwakeClock:
    """Counts elapsed seconds by naps.

    Parameters
    ----------
    nap_seconds : float
        Length of a nap in s.
    stopwatch : callable
        Elapsed seconds of the system.
    """

    def __init__(
        self,
        nap_seconds: float = NAP_SECONDS,
        stopwatch: Callable[[], float] = time.monotonic,
    ) -> None:
        self._nap, self._stopwatch = nap_seconds, stopwatch
        self._last = (0.0, stopwatch())  # what was counted before the present nap, and its begin

    def read(self) -> float:
        """Return the seconds that this clock has counted."""
        return self._read_at(self._stopwatch())

    def end_nap(self) -> None:
        """Count the nap that ends now, and begin the next one."""
        now = self._stopwatch()
        self._last = (self._read_at(now), now)

    def _read_at(self, now: float) -> float:
        counted, begun = self._last
        return counted + min(now - begun, self._nap)


_lock = threading.Lock()
_clock: AwakeClock | None = None


def read_awake_seconds() -> float:
    """Return for how long this process could run, in s since the first call."""
    global _clock
    clock = _clock
    if clock is None:
        with _lock:
            clock = _clock = _clock or _start_clock()
    return clock.read()


def _start_clock() -> AwakeClock:
    clock = AwakeClock(NAP_SECONDS)

    def take_naps() -> None:
        while True:
            time.sleep(NAP_SECONDS)
            clock.end_nap()

    threading.Thread(target=take_naps, name="awake clock", daemon=True).start()
    return clock
