"""Synchronous migration: copies of an island's best individuals replace another's worst."""

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
from sysid.kernels.borrowing import compile_borrowing
from sysid.search.evolution import reset_evidence, write_improvement
from sysid.search.island import Island
from sysid.search.operators import decode, encode, sort_population
from sysid.search.state import (
    PHASE_MIGRATION,
    Migrant,
)


class MigrationRoutes(NamedTuple):
    """Connections of the islands and migrants per connection, as compiled code reads them.

    Attributes
    ----------
    edges : IntArray, shape (E, 2)
        Source and destination.
    bits : IntArray, shape (I,)
        Bits of each island's chromosomes.
    most_migrants : int
        Limit for each edge.
    """

    edges: IntArray
    bits: IntArray
    most_migrants: int


def make_routes(bits: Sequence[int], migration: Migration, largest: int) -> MigrationRoutes:
    """Make the routes between islands; the largest island has `largest` individuals."""
    pairs = list_edges(migration.topology, len(bits))
    return MigrationRoutes(
        np.array(pairs, dtype=np.int64).reshape(len(pairs), 2),
        np.array(bits, dtype=np.int64),
        min(migration.migrants, largest),
    )


def migrate(
    islands: Sequence[Island], bits: Sequence[int], migration: Migration, epoch: int
) -> tuple[tuple[Island, ...], tuple[Migrant, ...]]:
    """Exchange migrants once; return the islands and the log.

    Synchronous: every island sends individuals that it had before the exchange. A migrant replaces
    the receiver's worst individual only if it is fitter and new there, so no island gets worse.
    `bits` are those of each island. Between islands of different bits the nearest chromosome
    arrives and is evaluated at its destination.
    """
    routes = make_routes(bits, migration, max(island.fitness.size for island in islands))
    packed, count = pack_islands(islands), len(routes.edges)
    log = allocate_log(count, count * routes.most_migrants, packed.champions.shape[1])
    exchange_migrants(routes, packed, epoch, log)
    return unpack_islands(packed, log, islands), list_migrants(log)


@compile_borrowing
def exchange_migrants(
    routes: MigrationRoutes, packed: PackedIslands, epoch: int, log: EvolutionLog
) -> None:
    """Exchange migrants once in place (see `migrate`). An edge writes one improvement at most."""
    words, fitness = packed.chromosomes.copy(), packed.fitness.copy()
    champions = packed.champions.copy()
    discontinuities = packed.search.fitness_discontinuities.copy()
    for e in range(routes.edges.shape[0]):
        source, destination = routes.edges[e, 0], routes.edges[e, 1]
        begin, end = packed.offsets[source], packed.offsets[source + 1]
        exact = routes.bits[source] == routes.bits[destination]
        receiver = packed.search[destination]  # a property of the fitness, not of the position:
        receiver.fitness_discontinuities = max(
            receiver.fitness_discontinuities, discontinuities[source]
        )
        for p in range(begin, min(end, begin + routes.most_migrants)):
            word = words[p : p + 1]
            if not exact:
                word = encode(decode(word, routes.bits[source]), routes.bits[destination])
            if not _accepts_migrant(packed, destination, word[0], fitness[p]):
                continue
            _insert_migrant(packed, destination, word[0], fitness[p] if exact else np.nan)
            line = log.migrants[log.counts[1]]
            line[0], line[1], line[2], line[3] = epoch, source, destination, fitness[p]
            log.counts[1] += 1
            if exact and p == begin and fitness[p] < packed.champion_rms[destination]:
                _record_champion(packed, destination, fitness[p], champions[source], log)


@compile_borrowing
def _accepts_migrant(packed: PackedIslands, island: int, word: WordArray, fitness: float) -> bool:
    """Return whether a migrant is fitter than the worst individual, and new on the island."""
    begin, end = packed.offsets[island], packed.offsets[island + 1]
    if not fitness < packed.fitness[end - 1]:  # nan (not evaluated yet) comes last and stays
        return False
    for p in range(begin, end):
        is_equal = True
        for d in range(word.size):
            is_equal &= packed.chromosomes[p, d] == word[d]
        if is_equal:
            return False
    return True


@compile_borrowing
def _insert_migrant(packed: PackedIslands, island: int, word: WordArray, fitness: float) -> None:
    """Replace the worst individual by a migrant."""
    begin, end = packed.offsets[island], packed.offsets[island + 1]
    for d in range(word.size):
        packed.chromosomes[end - 1, d] = word[d]
    packed.fitness[end - 1] = fitness
    sort_population(packed.chromosomes[begin:end], packed.fitness[begin:end])


@jit_compile
def _record_champion(
    packed: PackedIslands, island: int, fitness: float, values: FloatArray, log: EvolutionLog
) -> None:
    """Record that an island's new champion is a migrant."""
    search, row = packed.search[island], log.improvements[log.counts[0]]
    log.improvement_islands[log.counts[0]] = island
    log.counts[0] += 1
    write_improvement(search, fitness, PHASE_MIGRATION, values, row)
    search.stagnation, search.champion_converged = 0, False
    reset_evidence(search, fitness, packed.champion_rms[island])
    packed.champion_rms[island] = fitness
    for d in range(values.size):
        packed.champions[island, d] = values[d]
