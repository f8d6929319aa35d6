"""An island: one population between two generations, its evolution and its budgets."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray, WordArray
from sysid.kernels.abi import LANES
from sysid.search.adaptive_search import N_TRIALS
from sysid.search.evolution import repeats_chromosomes, run_generations
from sysid.search.known_fitness import make_known_fitness
from sysid.search.state import (
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
    """One population at one generation, an immutable value.

    Attributes
    ----------
    index : int
        Number of the island in the archipelago.
    seed : int
        The run's seed. Random numbers derive from seed and index.
    chromosomes : WordArray, shape (P, D)
        Chromosomes, fittest first.
    fitness : FloatArray, shape (P,)
        J of Eq. 10, ascending; ``inf``: diverged, ``nan``: not evaluated yet.
    search : SearchArray, shape ()
        State of the search (see `sysid.search.state.SEARCH_RECORD`).
    point : FloatArray, shape (D,)
        Present point of the local search.
    archive : FloatArray, shape (16, 2 + D)
        Minima in which searches from random points ended (`sysid.search.archive`).
    history : tuple of Improvement
        Every better champion since the start.
    """

    index: int
    seed: int
    chromosomes: WordArray
    fitness: FloatArray
    search: SearchArray
    point: FloatArray
    archive: FloatArray
    history: tuple[Improvement, ...] = ()

    @property
    def generation(self) -> int:
        """Generations completed."""
        return int(self.search["generation"])

    @property
    def evaluations(self) -> int:
        """Simulations run."""
        return int(self.search["evaluations"])

    @property
    def champion_rms(self) -> float:
        """Fitness of the best individual; ``inf`` before the first evaluation."""
        return self.history[-1].rms if self.history else float("inf")

    @property
    def arrays(self) -> IslandArrays:
        """The arrays themselves, not copies, for compiled code to change; nothing is known."""
        return IslandArrays(
            self.chromosomes,
            self.fitness,
            self.search[()],
            self.point,
            self.archive,
            make_known_fitness(0, self.point.size),
        )


def evolve(evaluator: Evaluator, plan: IslandPlan, island: Island, count: int) -> Island:
    """Evolve an island by `count` generations, or fewer if it comes to rest.

    ``evolve(…, a + b)`` equals ``evolve(…, b)`` of ``evolve(…, a)``, bit for bit.
    """
    after = replace(
        island,
        chromosomes=island.chromosomes.copy(),
        fitness=island.fitness.copy(),
        search=island.search.copy(),
        point=island.point.copy(),
        archive=island.archive.copy(),
    )
    rows = np.empty((count + 1, COLUMN_VALUES + island.point.size))
    known = make_known_fitness(int(repeats_chromosomes(plan.method)), island.point.size)
    arrays = after.arrays._replace(known=known)
    written = run_generations(evaluator, plan, count, arrays, rows)
    return replace(after, history=island.history + tuple(to_improvements(rows[:written])))


def to_improvements(rows: FloatArray) -> Iterator[Improvement]:
    """Convert the rows that compiled code wrote to improvements."""
    generations, evaluations, rms, phases = rows.T[:COLUMN_VALUES].tolist()
    names = [PHASE_NAMES[int(phase)] for phase in phases]
    values = map(tuple, rows[:, COLUMN_VALUES:].tolist())
    counts = (map(int, column) for column in (generations, evaluations))
    return map(Improvement, *counts, rms, names, values)


def stack_search(islands: Sequence[Island]) -> SearchArray:
    """Copy the search records of the islands into one array (I,)."""
    return np.array([island.search for island in islands], SEARCH_RECORD)


_UNLIMITED = 2**62
_NO_TARGET_RMS = -1.0


def split_population(algorithm: GeneticAlgorithm) -> tuple[int, ...]:
    """Split the population over the islands as evenly as possible."""
    size, remainder = divmod(algorithm.population, algorithm.n_islands)
    return tuple(size + (i < remainder) for i in range(algorithm.n_islands))


def get_island_settings(algorithm: GeneticAlgorithm, index: int) -> GeneticAlgorithm:
    """Get the settings of one island."""
    if not isinstance(algorithm.islands, tuple):
        return algorithm
    change = algorithm.islands[index]
    return replace(
        algorithm,
        method=change.method or algorithm.method,
        bits=change.bits or algorithm.bits,
        mutation=change.mutation or algorithm.mutation,
    )


def get_target_rms(algorithm: GeneticAlgorithm) -> float:
    """Get the fitness at which an island rests; negative: none."""
    target = algorithm.stop.rms
    return _NO_TARGET_RMS if target is None else float(target)


def compute_search_budget(algorithm: GeneticAlgorithm, n: int) -> int:
    """Compute the simulations for the islands: all but a tenth reserved for the refinement.

    The reserve covers at least a few refinement steps of n + 1 simulations. It also covers what the
    last step of each island may take beyond its share. It is at most half of the budget.
    """
    limit = algorithm.stop.evaluations
    if limit is None:
        return _UNLIMITED
    if not algorithm.refine:
        return limit
    last_steps = algorithm.n_islands * (n + LANES)
    return limit - min(max(limit // 10, 4 * (n + 2)) + last_steps, limit // 2)


def compute_analysis_budget(n: int) -> int:
    """Compute the simulations reserved for the standard errors of n parameters.

    Each parameter takes two, ten more near jumps of the output, and two more for the test of
    identifiability.
    """
    return 14 * n + 1


def _compute_island_budget(algorithm: GeneticAlgorithm, n: int, size: int) -> int:
    """Compute the number of simulations after which an island starts no further generation.

    It is the island's share of `compute_search_budget`. It is less for a tiny budget, so that the
    last generation stays within the island's share of what the standard errors leave.
    """
    limit = algorithm.stop.evaluations
    if limit is None:
        return _UNLIMITED
    share = compute_search_budget(algorithm, n) * size // algorithm.population
    available = (
        max(limit - compute_analysis_budget(n), algorithm.population) * size // algorithm.population
    )
    return max(1, min(share, available - _count_generation_evaluations(n, size) + 1))


def _count_generation_evaluations(n: int, size: int) -> int:
    """Count the simulations of one generation of an island, at most."""
    return size + n + 1 + N_TRIALS


def compute_start_budget(algorithm: GeneticAlgorithm, n: int) -> int:
    """Compute the simulations that islands and standard errors leave for the search of starts.

    They count as work of the first island, whose own search may be shorter for it.
    """
    limit = algorithm.stop.evaluations
    if limit is None:
        return _UNLIMITED
    taken = 0
    for size in split_population(algorithm)[1:]:
        island_budget = _compute_island_budget(algorithm, n, size)
        taken += (
            size
            if island_budget <= size
            else island_budget - 1 + _count_generation_evaluations(n, size)
        )
    return max(0, limit - (2 * n + 1) - split_population(algorithm)[0] - taken)
