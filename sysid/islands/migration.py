"""Migration: copies of the best of one island replace the worst of another, all at once."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.settings import Migration
from sysid.core.types import FloatArray, IntArray, WordArray
from sysid.islands.packed import (
    EvolutionLog,
    PackedIslands,
    allocate_log,
    list_migrants,
    pack_islands,
    unpack_islands,
)
from sysid.islands.topology import list_edges
from sysid.search.evolution import reset_evidence, write_improvement
from sysid.search.island import Island
from sysid.search.operators import decode, encode, sort_population
from sysid.search.state import (
    PHASE_MIGRATION,
    Migrant,
)


class MigrationRoutes(NamedTuple):
    """Who sends how many to whom, as compiled code reads it.

    Attributes
    ----------
    edges : IntArray, shape (E, 2)
        Source and destination.
    bits : IntArray, shape (I,)
        Of each island's chromosomes.
    migrants : int
        Of each edge, at most.
    """

    edges: IntArray
    bits: IntArray
    most_migrants: int


def make_routes(bits: Sequence[int], migration: Migration, largest: int) -> MigrationRoutes:
    """The routes between islands, the largest of which has so many individuals."""
    pairs = list_edges(migration.topology, len(bits))
    return MigrationRoutes(
        np.array(pairs, dtype=np.int64).reshape(len(pairs), 2),
        np.array(bits, dtype=np.int64),
        min(migration.migrants, largest),
    )


def migrate(
    islands: Sequence[Island], bits: Sequence[int], migration: Migration, epoch: int
) -> tuple[tuple[Island, ...], tuple[Migrant, ...]]:
    """The islands after one exchange, and its log.

    Synchronous: every island sends what it had before the exchange. A migrant replaces the
    receiver's worst individual only if it is fitter and not there already, so no island gets
    worse. `bits` are those of each island; between islands that differ the nearest chromosome
    arrives, to be evaluated at its destination.
    """
    ways = make_routes(bits, migration, max(island.fitness.size for island in islands))
    fleet, count = pack_islands(islands), len(ways.edges)
    news = allocate_log(count, count * ways.most_migrants, fleet.champions.shape[1])
    exchange_migrants(ways, fleet, epoch, news)
    return unpack_islands(fleet, news, islands), list_migrants(news)


@jit_compile
def exchange_migrants(
    ways: MigrationRoutes, fleet: PackedIslands, epoch: int, news: EvolutionLog
) -> None:
    """One exchange in place: see `migrate`. An edge writes one improvement at most."""
    words, fitness = fleet.chromosomes.copy(), fleet.fitness.copy()
    champions = fleet.champions.copy()
    discontinuities = fleet.search.fitness_discontinuities.copy()
    for e in range(ways.edges.shape[0]):
        source, destination = ways.edges[e, 0], ways.edges[e, 1]
        begin, end = fleet.offsets[source], fleet.offsets[source + 1]
        exact = ways.bits[source] == ways.bits[destination]
        known = fleet.search[destination]  # of the fitness, not of the place:
        known.fitness_discontinuities = max(known.fitness_discontinuities, discontinuities[source])
        for p in range(begin, min(end, begin + ways.most_migrants)):
            word = words[p : p + 1]
            if not exact:
                word = encode(decode(word, ways.bits[source]), ways.bits[destination])
            if not _accepts_migrant(fleet, destination, word[0], fitness[p]):
                continue
            _insert_migrant(fleet, destination, word[0], fitness[p] if exact else np.nan)
            line = news.migrants[news.counts[1]]
            line[0], line[1], line[2], line[3] = epoch, source, destination, fitness[p]
            news.counts[1] += 1
            if exact and p == begin and fitness[p] < fleet.champion_rms[destination]:
                _record_champion(fleet, destination, fitness[p], champions[source], news)


@jit_compile
def _accepts_migrant(fleet: PackedIslands, island: int, word: WordArray, fitness: float) -> bool:
    """Whether a migrant is fitter than the worst, and new here."""
    begin, end = fleet.offsets[island], fleet.offsets[island + 1]
    if not fitness < fleet.fitness[end - 1]:  # nan, not evaluated yet, comes last and is kept
        return False
    is_new = True
    for p in range(begin, end):
        is_new &= not np.all(fleet.chromosomes[p] == word)
    return is_new


@jit_compile
def _insert_migrant(fleet: PackedIslands, island: int, word: WordArray, fitness: float) -> None:
    """Put a migrant in the place of the worst individual."""
    begin, end = fleet.offsets[island], fleet.offsets[island + 1]
    for d in range(word.size):
        fleet.chromosomes[end - 1, d] = word[d]
    fleet.fitness[end - 1] = fitness
    sort_population(fleet.chromosomes[begin:end], fleet.fitness[begin:end])


@jit_compile
def _record_champion(
    fleet: PackedIslands, island: int, fitness: float, values: FloatArray, news: EvolutionLog
) -> None:
    """Note that an island's champion has come from another."""
    search, row = fleet.search[island], news.improvements[news.counts[0]]
    news.improvement_islands[news.counts[0]] = island
    news.counts[0] += 1
    write_improvement(search, fitness, PHASE_MIGRATION, values, row)
    search.stagnation, search.champion_converged = 0, 0
    reset_evidence(search, fitness, fleet.champion_rms[island])
    fleet.champion_rms[island] = fitness
    for d in range(values.size):
        fleet.champions[island, d] = values[d]
