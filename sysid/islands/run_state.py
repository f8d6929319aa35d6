"""State of a run: a value that can be pickled between any two compiled calls."""

from dataclasses import dataclass

import numpy as np

from sysid.core.types import FloatArray
from sysid.search.island import Island, stack_search
from sysid.search.state import SAME_OPTIMUM, Improvement, Migrant, SearchArray


@dataclass(frozen=True, slots=True, eq=False)
class RunState:
    """A run between two compiled calls.

    Attributes
    ----------
    seed : int
    islands : tuple of Island
        Some may be ahead of `generation`, up to the next border.
    generation : int
        The last border that all islands have passed.
    epoch : int
        Number of migrations so far.
    migrations : tuple of Migrant
    seconds : float
        Computing time so far.
    has_ended : bool
        Whether a stopping condition held at the last border.
    is_warm : bool
        Whether the run started from values of an earlier result.
    """

    seed: int
    islands: tuple[Island, ...]
    generation: int = 0
    epoch: int = 0
    migrations: tuple[Migrant, ...] = ()
    seconds: float = 0.0
    has_ended: bool = False
    is_warm: bool = False

    @property
    def evaluations(self) -> int:
        """Number of simulations run by all islands."""
        return sum(island.evaluations for island in self.islands)

    @property
    def rms(self) -> float:
        """Fitness of the best champion."""
        return min(island.champion_rms for island in self.islands)

    @property
    def champions_and_counters(self) -> tuple[FloatArray, SearchArray]:
        """RMS of the champions (I,) and search records (I,) of the islands."""
        rms = np.array([island.champion_rms for island in self.islands])
        return rms, stack_search(self.islands)

    def is_unimproved_since(self, generation: int) -> bool:
        """Return whether no island has improved on the best fitness since a generation."""
        largest_rms = self.rms * (1.0 + SAME_OPTIMUM)
        return any(
            improvement.rms <= largest_rms and improvement.generation <= generation
            for history in self.history
            for improvement in history
        )

    @property
    def history(self) -> tuple[tuple[Improvement, ...], ...]:
        """Improvements of each island."""
        return tuple(island.history for island in self.islands)
