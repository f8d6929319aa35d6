"""An island: one population between two generations, and its evolution as a pure function."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray, WordArray
from sysid.kernels.abi import LANES
from sysid.search.adaptive_search import N_TRIALS
from sysid.search.evolution import run_generations
from sysid.search.state import (
    COLUMN_EVALUATIONS,
    COLUMN_GENERATION,
    COLUMN_PHASE,
    COLUMN_RMS,
    COLUMN_VALUES,
    PHASE_NAMES,
    SEARCH_RECORD,
    Improvement,
    IslandArrays,
    IslandPlan,
    SearchArray,
)
from sysid.simulation.evaluator import Evaluator


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
    search : SearchArray, shape ()
        How far the search has got (see `sysid.search.state.SEARCH_RECORD`).
    point : FloatArray, shape (D,)
        Where the local search stands.
    history : tuple of Improvement
        Every better champion since the start.
    """

    index: int
    seed: int
    chromosomes: WordArray
    fitness: FloatArray
    search: SearchArray
    point: FloatArray
    history: tuple[Improvement, ...] = ()

    @property
    def generation(self) -> int:
        """Generations completed."""
        return int(self.search.generation)

    @property
    def evaluations(self) -> int:
        """Simulations run."""
        return int(self.search.evaluations)

    @property
    def champion_rms(self) -> float:
        """Fitness of the best individual; ``inf`` before the first evaluation."""
        return self.history[-1].rms if self.history else float("inf")

    @property
    def arrays(self) -> IslandArrays:
        """What compiled code reads and changes: not copies."""
        return IslandArrays(self.chromosomes, self.fitness, self.search[()], self.point)


def evolve(evaluator: Evaluator, plan: IslandPlan, island: Island, count: int) -> Island:
    """The island after `count` generations, fewer where it comes to rest.

    ``evolve(…, a + b)`` equals ``evolve(…, b)`` of ``evolve(…, a)``, bit for bit.
    """
    after = replace(
        island,
        chromosomes=island.chromosomes.copy(),
        fitness=island.fitness.copy(),
        search=island.search.copy(),
        point=island.point.copy(),
    )
    rows = np.empty((count + 1, COLUMN_VALUES + island.point.size))
    written = run_generations(evaluator, plan, count, after.arrays, rows)
    better = tuple(to_improvement(row) for row in rows[:written].tolist())
    return replace(after, history=island.history + better)


def to_improvement(row: Sequence[float]) -> Improvement:
    """An improvement, of the row that compiled code wrote of it."""
    return Improvement(
        int(row[COLUMN_GENERATION]),
        int(row[COLUMN_EVALUATIONS]),
        row[COLUMN_RMS],
        PHASE_NAMES[int(row[COLUMN_PHASE])],
        tuple(row[COLUMN_VALUES:]),
    )


def stack_search(islands: Sequence[Island]) -> SearchArray:
    """Copies of the islands' search records (I,)."""
    return np.array([island.search for island in islands], SEARCH_RECORD).view(np.recarray)


_UNLIMITED = 2**62
NO_TARGET_RMS = -1.0


def split_population(algorithm: GeneticAlgorithm) -> tuple[int, ...]:
    """Individuals of each island: the population dealt as evenly as possible."""
    each, more = divmod(algorithm.population, algorithm.n_islands)
    return tuple(each + (i < more) for i in range(algorithm.n_islands))


def get_island_settings(algorithm: GeneticAlgorithm, index: int) -> GeneticAlgorithm:
    """The settings of one island, where islands differ."""
    if not isinstance(algorithm.islands, tuple):
        return algorithm
    change = algorithm.islands[index]
    return replace(
        algorithm,
        method=change.method or algorithm.method,
        bits=change.bits or algorithm.bits,
        mutation=change.mutation or algorithm.mutation,
    )


def compute_search_budget(algorithm: GeneticAlgorithm, n: int) -> int:
    """Simulations that the islands may run: all but a tenth kept for the refinement.

    At least a few steps of the refinement (of n + 1 simulations) and at most half are kept, and
    what the last step of each island may take beyond its share.
    """
    limit = algorithm.stop.evaluations
    if limit is None:
        return _UNLIMITED
    if not algorithm.refine:
        return limit
    beyond = algorithm.n_islands * (n + LANES)
    return limit - min(max(limit // 10, 4 * (n + 2)) + beyond, limit // 2)


def compute_analysis_budget(n: int) -> int:
    """Simulations kept for the standard errors of n parameters.

    They take two a parameter, beside jumps of the output ten more, and a look at what cannot be
    told two more.
    """
    return 14 * n + 1


def _compute_island_budget(algorithm: GeneticAlgorithm, n: int, size: int) -> int:
    """Simulations from which on an island begins no other generation.

    Its share of `compute_search_budget`; of a tiny budget less, so that its last generation does
    not take it beyond its share of what the standard errors leave.
    """
    limit = algorithm.stop.evaluations
    if limit is None:
        return _UNLIMITED
    share = compute_search_budget(algorithm, n) * size // algorithm.population
    left = (
        max(limit - compute_analysis_budget(n), algorithm.population) * size // algorithm.population
    )
    return max(1, min(share, left - _count_generation_evaluations(n, size) + 1))


def _count_generation_evaluations(n: int, size: int) -> int:
    """Simulations of one generation of an island at most."""
    return size + n + 1 + N_TRIALS


def compute_start_budget(algorithm: GeneticAlgorithm, n: int) -> int:
    """What the islands and the standard errors leave of the budget to the finding of starts.

    It counts as the first island's work, which may be less than its share for that.
    """
    limit = algorithm.stop.evaluations
    if limit is None:
        return _UNLIMITED
    taken = 0
    for size in split_population(algorithm)[1:]:
        rests = _compute_island_budget(algorithm, n, size)
        taken += size if rests <= size else rests - 1 + _count_generation_evaluations(n, size)
    return max(0, limit - (2 * n + 1) - split_population(algorithm)[0] - taken)
