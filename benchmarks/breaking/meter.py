"""Whose processor time a stretch of time had: a service's, others', or nobody's."""

import os
import threading
from pathlib import Path
from typing import NamedTuple

from benchmarks.breaking.processes import Family

PAUSE_SECONDS = 0.5
TICKS = os.sysconf("SC_CLK_TCK")


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
        self._seen: dict[tuple[int, int], float] = {}
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
            for pid, one in self._family.members().items():
                seconds = _seconds_of(pid)
                if seconds is not None:
                    self._seen[pid, one.started] = seconds
            own = sum(self._seen.values())
        busy, idle = _machine()
        return Reading(own, busy, idle)

    def _go_on(self) -> None:
        while not self._ending.wait(PAUSE_SECONDS):
            self.read()


def _seconds_of(pid: int) -> float | None:
    try:
        text = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return None
    fields = text.rpartition(")")[2].split()  # from the third on, as proc_pid_stat(5) counts them
    return (int(fields[11]) + int(fields[12])) / TICKS


def _machine() -> tuple[float, float]:
    """Busy and idle seconds of all processors, as proc_stat(5) has them."""
    first = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]
    user, nice, system, idle, waiting, interrupts, soft, stolen = map(int, first)
    busy = user + nice + system + interrupts + soft + stolen
    return busy / TICKS, (idle + waiting) / TICKS
