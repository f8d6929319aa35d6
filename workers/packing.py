"""Division of work into tasks, by pure functions of measured cost.

A task should last 0.2 to 1 s. If it is shorter, Ray's overhead of a millisecond a task shows. If it
is longer, progress, cancellation and fairness suffer. Results never depend on this.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

PACK_SECONDS = 0.5
"""Target compute time of a task."""

FIRST_SLICE_SECONDS = 0.15
"""First slice of a run; it is shorter, so that progress is visible at once."""

PACKS_PER_CPU = 2
"""Packs in flight for each core: one computes, one waits."""

WORTH_SPREADING_SECONDS = 0.02
"""An island's epoch that takes less gets no task of its own."""

PACK_TOLERANCE = 1.5
"""A run this many times longer than the mean of its job still fits into an uncut pack."""

PREVIOUS_WEIGHT = 0.7
"""Weight of the previous mean when a new cost is measured."""


@dataclass(frozen=True, slots=True)
class MeanCost:
    """Running mean of the cost of one item of a job; `seconds` is None before the first."""

    seconds: float | None = None

    def add_measurement(self, seconds: float) -> "MeanCost":
        """Return the mean after one more item."""
        if self.seconds is None:
            return MeanCost(seconds)
        return MeanCost(PREVIOUS_WEIGHT * self.seconds + (1 - PREVIOUS_WEIGHT) * seconds)


def choose_pack_size(cost: MeanCost, waiting: int, slots: int) -> int:
    """Choose how many of `waiting` equal items go into the next task.

    One while the cost is unknown. Never more than an equal share of the waiting items, so that
    every core is busy at the end of a sweep.
    """
    if cost.seconds is None:
        return min(1, waiting)
    by_cost = int(PACK_SECONDS / max(cost.seconds, 1e-4))
    share = ceil(waiting / max(slots, 1))
    return min(max(1, min(by_cost, share)), waiting)


def choose_slice_seconds(slices: int, cost: MeanCost | None = None) -> float:
    """Choose the length of a run's next time slice after `slices` of them.

    If by `cost` the run fits into a pack, it is not cut: each cut is one task more.
    """
    if (
        cost is not None
        and cost.seconds is not None
        and cost.seconds <= PACK_SECONDS / PACK_TOLERANCE
    ):
        return PACK_SECONDS
    return min(PACK_SECONDS, FIRST_SLICE_SECONDS * 2.0 ** min(slices, 10))


def is_worth_spreading(epoch_seconds: float, islands: int, idle: int) -> bool:
    """Whether the islands of one run should go to several tasks instead of one.

    Parameters
    ----------
    epoch_seconds : float
        Cost of one epoch of all islands on one core.
    islands, idle : int
        Islands of the run; cores without work.
    """
    return idle > 0 and islands > 1 and epoch_seconds / islands >= WORTH_SPREADING_SECONDS


def balance_packs(costs: Sequence[float], bins: int) -> tuple[tuple[int, ...], ...]:
    """Distribute indices over at most `bins` packs of about equal cost (longest first)."""
    count = min(bins, len(costs))
    packs: list[list[int]] = [[] for _ in range(count)]
    loads = [0.0] * count
    for index in sorted(range(len(costs)), key=lambda i: (-costs[i], i)):
        lightest = loads.index(min(loads))
        packs[lightest].append(index)
        loads[lightest] += costs[index]
    return tuple(tuple(sorted(pack)) for pack in packs)
