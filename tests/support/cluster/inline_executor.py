"""Executor in this process: the plain loop that a cluster must equal bit for bit."""

from collections import deque

from workers.errors import PackCancelled
from workers.protocol import Pack, PackHandle, PackResult, Records
from workers.tasks import run_pack


class InlineExecutor:
    """Computes each pack on the call that waits for it; a `workers.protocol.Executor`."""

    def __init__(self, slots: int = 1) -> None:
        self.slots = slots
        self._waiting: deque[int] = deque()
        self._packs: dict[int, Pack | None] = {}
        self._results: dict[int, PackResult] = {}
        self._next = 0

    def share_records(self, records: Records) -> Records:
        """Return the records unchanged: nothing needs to be sent."""
        return records

    def submit_pack(self, pack: Pack) -> PackHandle:
        """Put a pack at the end of the queue."""
        self._next += 1
        self._packs[self._next] = pack
        self._waiting.append(self._next)
        return self._next

    def wait_for_packs(self, timeout: float) -> tuple[PackHandle, ...]:
        """Compute the next pack, however long it takes."""
        if not self._waiting:
            return ()
        handle = self._waiting.popleft()
        pack = self._packs[handle]
        if pack is not None:
            self._results[handle] = run_pack(
                pack.encoder, pack.items, tuple(pack.records), *pack.records.values()
            )
        return (handle,)

    def fetch_results(self, handle: PackHandle) -> PackResult:
        """Return the results of a pack.

        Raises
        ------
        PackCancelled
            If it was cancelled while it waited.
        """
        del self._packs[handle]
        if handle not in self._results:
            raise PackCancelled("cancelled")
        return self._results.pop(handle)

    def cancel_pack(self, handle: PackHandle, *, force: bool) -> None:
        """Drop the items of a pack."""
        self._packs[handle] = None

    def check_cluster_alive(self) -> None:
        """Nothing to do: this process lives."""

    def close(self) -> None:
        """Nothing to do."""
