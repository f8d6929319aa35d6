"""Packs that do not come back: their worker hangs, whatever holds it.

A disk that does not answer, a stopped process, a machine that swaps and an endless native loop look
alike from here. All of them are known by the time that packs of the job take otherwise.
"""

from collections.abc import Mapping
from typing import Generic, TypeVar

FIRST_LIMIT_SECONDS = 3600.0
"""Limit of an item while no run of its job has ended, and of one that is given away a second time:
then a wrong guess costs time, and no run."""

MIN_LIMIT_SECONDS = 30.0
"""Least limit: a new worker starts within this time on a busy machine, and a swap passes."""

LIMIT_FACTOR = 20.0
"""A pack may take this many times what one with the longest item of its job takes."""

PACK_LIMIT_SECONDS = 1.0
"""No further item of a pack is started after this time; the rest is returned unchanged."""

Handle = TypeVar("Handle")


def compute_time_limit(longest: float | None) -> float:
    """Compute the time limit of a pack in s.

    A pack begins no item after `PACK_LIMIT_SECONDS`. So the number of its items does not count.

    Parameters
    ----------
    longest : float or None
        Time of the longest item of its job in s; None while that is unknown.
    """
    if longest is None:
        return FIRST_LIMIT_SECONDS
    return max(MIN_LIMIT_SECONDS, LIMIT_FACTOR * (PACK_LIMIT_SECONDS + longest))


class PackWatch(Generic[Handle]):
    """Times of the packs in flight. One begins when it is among the oldest, one for each core."""

    def __init__(self) -> None:
        self._begun: dict[Handle, float | None] = {}  # the oldest first

    def find_overdue(
        self, limits: Mapping[Handle, float], n_cores: int, now: float
    ) -> list[Handle]:
        """Find the packs that are beyond their limits.

        Parameters
        ----------
        limits : mapping
            The packs in flight, with the time limit of each in s.
        n_cores : int
            Cores whose workers answer.
        now : float
            Elapsed time in s.
        """
        begun = {handle: at for handle, at in self._begun.items() if handle in limits}
        begun.update((handle, None) for handle in limits if handle not in begun)
        for handle in list(begun)[: max(0, n_cores)]:
            if begun[handle] is None:
                begun[handle] = now
        self._begun = begun
        return [
            handle for handle, at in begun.items() if at is not None and now - at > limits[handle]
        ]
