"""The islands of a run one behind the other, as compiled code reads and changes them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray, IntArray, WordArray
from sysid.search.island import Island, stack_search, to_improvement
from sysid.search.state import COLUMN_VALUES, Improvement, Migrant, SearchArray


class PackedIslands(NamedTuple):
    """All islands of a run.

    Attributes
    ----------
    first : IntArray, shape (I + 1,)
        Island i has the individuals ``first[i]`` to ``first[i + 1] - 1``.
    words : WordArray, shape (P, D)
    fitness : FloatArray, shape (P,)
    search : SearchArray, shape (I,)
    points : FloatArray, shape (I, D)
        Up to here, those of `sysid.search.island.Island`.
    rms : FloatArray, shape (I,)
        Of each island's best individual so far; ``inf`` before the first evaluation.
    champions : FloatArray, shape (I, D)
        Its values; arbitrary before the first evaluation.
    """

    offsets: IntArray
    chromosomes: WordArray
    fitness: FloatArray
    search: SearchArray
    points: FloatArray
    champion_rms: FloatArray
    champions: FloatArray


class EvolutionLog(NamedTuple):
    """What compiled code writes down of the islands of a fleet.

    Attributes
    ----------
    improvements : FloatArray, shape (R, VALUES + D)
    owners : IntArray, shape (R,)
        The island of each.
    migrants : FloatArray, shape (L, 4)
        Epoch, source, destination and fitness of each.
    written : IntArray, shape (2,)
        How many improvements and migrants there are.
    """

    improvements: FloatArray
    improvement_islands: IntArray
    migrants: FloatArray
    counts: IntArray


def pack_islands(islands: Sequence[Island]) -> PackedIslands:
    """Copies of the islands' arrays, one behind the other."""
    champions = np.zeros((len(islands), islands[0].chromosomes.shape[1]))
    for i, island in enumerate(islands):
        if island.history:
            champions[i] = island.history[-1].parameters
    return PackedIslands(
        np.cumsum([0, *(island.fitness.size for island in islands)]),
        np.concatenate([island.chromosomes for island in islands]),
        np.concatenate([island.fitness for island in islands]),
        stack_search(islands),
        np.array([island.point for island in islands]),
        np.array([island.champion_rms for island in islands]),
        champions,
    )


def unpack_islands(
    fleet: PackedIslands, news: EvolutionLog, islands: Sequence[Island]
) -> tuple[Island, ...]:
    """The islands as they are in the fleet, their histories longer by what is new."""
    better: list[list[Improvement]] = [[] for _ in islands]
    count = int(news.counts[0])
    owners, rows = news.improvement_islands[:count].tolist(), news.improvements[:count].tolist()
    for owner, row in zip(owners, rows, strict=True):
        better[owner].append(to_improvement(row))
    ends = fleet.offsets.tolist()
    return tuple(
        Island(
            island.index,
            island.seed,
            fleet.chromosomes[begin:end],
            fleet.fitness[begin:end],
            fleet.search[i, ...],
            fleet.points[i],
            (*island.history, *better[i]),
        )
        for i, (island, begin, end) in enumerate(zip(islands, ends[:-1], ends[1:], strict=True))
    )


def allocate_log(improvements: int, migrants: int, n: int) -> EvolutionLog:
    """Room for so many improvements of n parameters and so many migrants."""
    return EvolutionLog(
        np.empty((improvements, COLUMN_VALUES + n)),
        np.empty(improvements, dtype=np.int64),
        np.empty((migrants, 4)),
        np.zeros(2, dtype=np.int64),
    )


def list_migrants(news: EvolutionLog) -> tuple[Migrant, ...]:
    """The migrants that arrived."""
    rows = news.migrants[: int(news.counts[1])].tolist()
    return tuple(Migrant(int(at), int(a), int(b), fitness) for at, a, b, fitness in rows)
