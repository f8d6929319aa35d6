"""An island: one population between two generations, and its evolution as a pure function."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sysid.ga.evolution import generations
from sysid.ga.state import (
    AT_EVALUATIONS,
    AT_GENERATION,
    EVALUATIONS,
    GENERATION,
    PHASE,
    PHASES,
    RMS,
    VALUES,
    Plan,
)  # fmt: skip
from sysid.kernels.evaluator import Evaluator
from sysid.result import Improvement
from sysid.types import FloatArray, IntArray, WordArray


@dataclass(frozen=True, slots=True, eq=False)
class Island:
    """One population at one generation. A value: to evolve is to make a new one.

    Attributes
    ----------
    index : int
        Its number in the archipelago.
    seed : int
        The run's seed: with the index, what its random numbers derive from.
    words : WordArray, shape (P, D)
        Chromosomes, fittest first.
    fitness : FloatArray, shape (P,)
        J of Eq. 10, ascending; ``inf`` diverges, ``nan`` is not evaluated yet.
    counters : IntArray
        Generation, evaluations and the phase of the search (see `sysid.ga.state`).
    memory : FloatArray
        What a sequence search carries from one generation to the next.
    history : tuple of Improvement
        Every better champion since the start.
    """

    index: int
    seed: int
    words: WordArray
    fitness: FloatArray
    counters: IntArray
    memory: FloatArray
    history: tuple[Improvement, ...] = ()

    @property
    def generation(self) -> int:
        """Generations completed."""
        return int(self.counters[GENERATION])

    @property
    def evaluations(self) -> int:
        """Simulations run."""
        return int(self.counters[EVALUATIONS])

    @property
    def champion_rms(self) -> float:
        """Fitness of the best individual; ``inf`` before the first evaluation."""
        return self.history[-1].rms if self.history else float("inf")


def evolve(evaluator: Evaluator, plan: Plan, island: Island, count: int) -> Island:
    """The island after `count` generations, fewer where it comes to rest.

    ``evolve(…, a + b)`` equals ``evolve(…, b)`` of ``evolve(…, a)``, bit for bit.
    """
    words, fitness = island.words.copy(), island.fitness.copy()
    counters, memory = island.counters.copy(), island.memory.copy()
    rows = np.empty((count + 1, VALUES + words.shape[1]))
    written = generations(evaluator, plan, count, words, fitness, counters, memory, rows)
    better = tuple(improvement(row) for row in rows[:written].tolist())
    history = island.history + better
    return Island(island.index, island.seed, words, fitness, counters, memory, history)


def improvement(row: Sequence[float]) -> Improvement:
    """An improvement, of the row that compiled code wrote of it."""
    return Improvement(
        int(row[AT_GENERATION]),
        int(row[AT_EVALUATIONS]),
        row[RMS],
        PHASES[int(row[PHASE])],
        tuple(row[VALUES:]),
    )
