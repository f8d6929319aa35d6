"""Values that take long to compute, remembered by the processes that answer requests."""

import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from threading import BoundedSemaphore, Lock
from typing import Any, TypeVar, cast

from service.core.errors import ServiceBusy

FRESH_SECONDS = 0.05
"""What took less and may change is computed anew each time."""
REUSE_FACTOR = 20
"""What took longer is used again for so many times its time."""
MAX_WAITING = 16
"""Requests of this process that wait while others compute their value: each one holds one of the
threads that all need."""
_waiting = BoundedSemaphore(MAX_WAITING)

T = TypeVar("T")


@dataclass(slots=True)
class _Entry:
    lock: Lock = field(default_factory=Lock)
    value: Any = None
    made_at: float | None = None
    seconds: float = 0.0

    def is_usable(self, *, is_final: bool) -> bool:
        if self.made_at is None:
            return False
        age = time.monotonic() - self.made_at
        return is_final or (self.seconds > FRESH_SECONDS and age < REUSE_FACTOR * self.seconds)


class ComputedValues:
    """The values that were requested last. Requests for one value at once compute it once.

    Parameters
    ----------
    size : int
        Most values that are remembered.
    """

    def __init__(self, size: int) -> None:
        self._lock, self._size = Lock(), size
        self._entries: OrderedDict[Hashable, _Entry] = OrderedDict()

    def get(
        self,
        key: Hashable,
        compute: Callable[[], T],
        *,
        is_final: bool,
        before_wait: Callable[[], object] = lambda: None,
    ) -> T:
        """Return the value of a key.

        A value that `is_final` is computed once. Another one is computed again once its age is
        `REUSE_FACTOR` times what it took, so that readers of a running sweep take a small part of
        the processor, however many they are.

        Parameters
        ----------
        before_wait : callable
            Releases what the caller need not hold while another request computes the value.

        Raises
        ------
        ServiceBusy
            If too many requests wait already.

        Examples
        --------
        >>> squares = ComputedValues(size=10)
        >>> squares.get(3, lambda: 3**2, is_final=True)
        9
        """
        with self._lock:
            entry = self._entries.setdefault(key, _Entry())
            self._entries.move_to_end(key)
            while len(self._entries) > self._size:
                self._entries.popitem(last=False)
        if not entry.lock.acquire(blocking=False):
            before_wait()
            _wait_for(entry.lock)
        try:
            if not entry.is_usable(is_final=is_final):
                begun = time.monotonic()
                entry.value = compute()
                entry.made_at = time.monotonic()
                entry.seconds = entry.made_at - begun
            return cast(T, entry.value)
        finally:
            entry.lock.release()


def _wait_for(lock: Lock) -> None:
    if not _waiting.acquire(blocking=False):
        raise ServiceBusy("too many requests wait for the same result; ask again in a few seconds")
    try:
        lock.acquire()
    finally:
        _waiting.release()
