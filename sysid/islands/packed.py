"""The islands of a run packed into common arrays, which compiled code reads and changes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.types import FloatArray, IntArray, WordArray
from sysid.search.island import Island, stack_search, to_improvements
from sysid.search.state import COLUMN_VALUES, Improvement, Migrant, SearchArray


class PackedIslands(NamedTuple):
    """All islands of a run.

    Attributes
    ----------
    offsets : IntArray, shape (I + 1,)
        Island i has the individuals ``offsets[i]`` to ``offsets[i + 1] - 1``.
    chromosomes : WordArray, shape (P, D)
    fitness : FloatArray, shape (P,)
    search : SearchArray, shape (I,)
    points : FloatArray, shape (I, D)
    archives : FloatArray, shape (I, 16, 2 + D)
        This array and those above are those of `sysid.search.island.Island`.
    champion_rms : FloatArray, shape (I,)
        RMS of each island's best individual so far; ``inf`` before the first evaluation.
    champions : FloatArray, shape (I, D)
        Its parameters; arbitrary before the first evaluation.
    """

    offsets: IntArray
    chromosomes: WordArray
    fitness: FloatArray
    search: SearchArray
    points: FloatArray
    archives: FloatArray
    champion_rms: FloatArray
    champions: FloatArray


class EvolutionLog(NamedTuple):
    """Log that compiled code writes: improvements of the islands, and migrants.

    Attributes
    ----------
    improvements : FloatArray, shape (R, VALUES + D)
    improvement_islands : IntArray, shape (R,)
        The island of each improvement.
    migrants : FloatArray, shape (L, 4)
        Epoch, source, destination and fitness of each.
    counts : IntArray, shape (2,)
        Numbers of improvements and of migrants written.
    """

    improvements: FloatArray
    improvement_islands: IntArray
    migrants: FloatArray
    counts: IntArray


def pack_islands(islands: Sequence[Island]) -> PackedIslands:
    """Copy the arrays of the islands into common ones."""
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
        np.array([island.archive for island in islands]),
        np.array([island.champion_rms for island in islands]),
        champions,
    )


def unpack_islands(
    packed: PackedIslands, log: EvolutionLog, islands: Sequence[Island]
) -> tuple[Island, ...]:
    """Make islands of the packed arrays, and append the log to their histories."""
    new_improvements: list[list[Improvement]] = [[] for _ in islands]
    count = int(log.counts[0])
    improvements = to_improvements(log.improvements[:count])
    for index, improvement in zip(
        log.improvement_islands[:count].tolist(), improvements, strict=True
    ):
        new_improvements[index].append(improvement)
    ends = packed.offsets.tolist()
    return tuple(
        Island(
            island.index,
            island.seed,
            packed.chromosomes[begin:end],
            packed.fitness[begin:end],
            packed.search[i, ...],
            packed.points[i],
            packed.archives[i],
            (*island.history, *new_improvements[i]),
        )
        for i, (island, begin, end) in enumerate(zip(islands, ends[:-1], ends[1:], strict=True))
    )


def allocate_log(improvements: int, migrants: int, n: int) -> EvolutionLog:
    """Allocate a log for so many improvements of n parameters and so many migrants."""
    return EvolutionLog(
        np.empty((improvements, COLUMN_VALUES + n)),
        np.empty(improvements, dtype=np.int64),
        np.empty((migrants, 4)),
        np.zeros(2, dtype=np.int64),
    )


def list_migrants(log: EvolutionLog) -> tuple[Migrant, ...]:
    """List the migrants in a log."""
    rows = log.migrants[: int(log.counts[1])].tolist()
    return tuple(
        Migrant(int(epoch), int(source), int(destination), fitness)
        for epoch, source, destination, fitness in rows
    )
