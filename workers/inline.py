"""A crew of one: this process. The plain loop that a cluster must equal bit for bit."""

from collections import deque
from collections.abc import Sequence
from typing import Any

from workers.errors import PackCancelled
from workers.ports import Done, Handle, Item, Records
from workers.tasks import advance


class InlineCrew:
    """Computes each pack when it is waited for; implements `workers.ports.Crew`."""

    def __init__(self, slots: int = 1) -> None:
        self.slots = slots
        self._waiting: deque[int] = deque()
        self._packs: dict[int, tuple[tuple[Item, ...], tuple[str, ...], tuple[Records, ...]]] = {}
        self._results: dict[int, tuple[Done, ...]] = {}
        self._next = 0

    def share(self, records: Records) -> Records:
        """Nothing to do: everybody is here."""
        return records

    def submit(self, pack: Sequence[Item], keys: Sequence[str], shared: Sequence[Any]) -> Handle:
        """Put a pack at the end of the queue."""
        self._next += 1
        self._packs[self._next] = (tuple(pack), tuple(keys), tuple(shared))
        self._waiting.append(self._next)
        return self._next

    def finished(self, timeout: float) -> tuple[Handle, ...]:
        """Compute the next pack, whatever time it takes."""
        if not self._waiting:
            return ()
        handle = self._waiting.popleft()
        pack, keys, shared = self._packs[handle]
        if pack:
            self._results[handle] = advance(pack, keys, *shared)
        return (handle,)

    def fetch(self, handle: Handle) -> tuple[Done, ...]:
        """What the pack gave.

        Raises
        ------
        PackCancelled
            If it was cancelled while it waited.
        """
        del self._packs[handle]
        if handle not in self._results:
            raise PackCancelled("cancelled")
        return self._results.pop(handle)

    def cancel(self, handle: Handle, *, force: bool) -> None:
        """Compute nothing of that pack."""
        self._packs[handle] = ((), (), ())

    def check(self) -> None:
        """Nothing to do: this process lives."""

    def close(self) -> None:
        """Nothing to do."""
