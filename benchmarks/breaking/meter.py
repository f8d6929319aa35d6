"""Measure processor time over an interval: the service's, other programs', and idle time."""

import threading
from contextlib import suppress
from typing import NamedTuple

import psutil

from benchmarks.breaking.processes import Family

PAUSE_SECONDS = 0.5


class Reading(NamedTuple):
    """Seconds of processor time since some moment: of a service, and of all on this machine."""

    own: float
    all: float
    idle: float

    def since(self, before: "Reading") -> "Reading":
        """What came between."""
        return Reading(*(now - then for now, then in zip(self, before, strict=True)))

    @property
    def share_of_others(self) -> float:
        """Of all processor time that there was, what neither the service had nor nobody."""
        whole = self.all + self.idle
        return max(0.0, self.all - self.own) / whole if whole > 0 else 0.0


class Meter:
    """Adds up what the processes of a service take, those that end meanwhile too.

    A process counts as it was last seen, so the last half second of one that ends is missing; it
    is then counted as others'.
    """

    def __init__(self, family: Family) -> None:
        self._family = family
        self._seen: dict[psutil.Process, float] = {}
        self._lock, self._ending = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._go_on, daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def stop(self) -> None:
        """Look no longer."""
        self._ending.set()
        self._thread.join()

    def read(self) -> Reading:
        """What there was until now."""
        with self._lock:
            for process in self._family.members():
                with suppress(psutil.NoSuchProcess):
                    times = process.cpu_times()
                    self._seen[process] = times.user + times.system
            own = sum(self._seen.values())
        busy, idle = _machine()
        return Reading(own, busy, idle)

    def _go_on(self) -> None:
        while not self._ending.wait(PAUSE_SECONDS):
            self.read()


def _machine() -> tuple[float, float]:
    """Busy and idle seconds of all processors."""
    times = psutil.cpu_times()
    busy = times.user + times.nice + times.system + times.irq + times.softirq + times.steal
    return busy, times.idle + times.iowait
