"""The state of a run: a value that can be pickled between any two compiled calls."""

from dataclasses import dataclass

from sysid.ga.island import Island
from sysid.ga.state import CLIFFS, CONFIRMED, HOPS, RETURNED, SAME, TRIED
from sysid.result import Improvement, Migrant


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
        Exchanges of migrants done.
    migrations : tuple of Migrant
    seconds : float
        Time computed so far.
    ended : bool
        Whether an end condition held at the last border.
    is_warm : bool
        Whether it was given values of an earlier result to begin with.
    """

    seed: int
    islands: tuple[Island, ...]
    generation: int = 0
    epoch: int = 0
    migrations: tuple[Migrant, ...] = ()
    seconds: float = 0.0
    ended: bool = False
    is_warm: bool = False

    @property
    def evaluations(self) -> int:
        """Simulations run by all islands."""
        return sum(island.evaluations for island in self.islands)

    @property
    def rms(self) -> float:
        """Fitness of the best champion."""
        return min(island.champion_rms for island in self.islands)

    @property
    def independent(self) -> int:
        """How many searches began at new random places."""
        return sum(int(island.counters[TRIED]) for island in self.islands)

    @property
    def confirmed(self) -> int:
        """How many searches from new random places led to the best champion's fitness."""
        most = self.rms * (1.0 + SAME)
        return sum(int(i.counters[CONFIRMED]) for i in self.islands if i.champion_rms <= most)

    @property
    def hops(self) -> tuple[int, int]:
        """Searches from beside the best champion, and how many of them led back to it."""
        most = self.rms * (1.0 + SAME)
        best = [i.counters for i in self.islands if i.champion_rms <= most]
        return sum(int(c[HOPS]) for c in best), sum(int(c[RETURNED]) for c in best)

    @property
    def has_cliffs(self) -> bool:
        """Whether a search from beside the best champion has met jumps of the fitness."""
        most = self.rms * (1.0 + SAME)
        return any(i.counters[CLIFFS] > 0 for i in self.islands if i.champion_rms <= most)

    def is_the_best_since(self, generation: int) -> bool:
        """Whether the best fitness was found by then, and nothing better after."""
        most = self.rms * (1.0 + SAME)
        return any(
            one.rms <= most and one.generation <= generation
            for history in self.history for one in history
        )  # fmt: skip

    @property
    def history(self) -> tuple[tuple[Improvement, ...], ...]:
        """Improvements of each island."""
        return tuple(island.history for island in self.islands)
