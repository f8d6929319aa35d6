"""Migration: copies of the best of one island replace the worst of another, all at once."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sysid.core.jit import compiled
from sysid.core.settings import Migration
from sysid.core.types import FloatArray, IntArray, WordArray
from sysid.islands.packed import Fleet, News, dealt, empty_news, gathered, migrations
from sysid.islands.topology import edges
from sysid.search.evolution import reset_evidence, write_improvement
from sysid.search.island import Island
from sysid.search.operators import coded, decoded, rank
from sysid.search.state import (
    MIGRATION,
    Migrant,
)


class Routes(NamedTuple):
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
    migrants: int


def routes(bits: Sequence[int], migration: Migration, largest: int) -> Routes:
    """The routes between islands, the largest of which has so many individuals."""
    pairs = edges(migration.topology, len(bits))
    return Routes(
        np.array(pairs, dtype=np.int64).reshape(len(pairs), 2),
        np.array(bits, dtype=np.int64), min(migration.migrants, largest),
    )  # fmt: skip


def migrate(
    islands: Sequence[Island], bits: Sequence[int], migration: Migration, epoch: int
) -> tuple[tuple[Island, ...], tuple[Migrant, ...]]:
    """The islands after one exchange, and its log.

    Synchronous: every island sends what it had before the exchange. A migrant replaces the
    receiver's worst individual only if it is fitter and not there already, so no island gets
    worse. `bits` are those of each island; between islands that differ the nearest chromosome
    arrives, to be evaluated at its destination.
    """
    ways = routes(bits, migration, max(island.fitness.size for island in islands))
    fleet, count = gathered(islands), len(ways.edges)
    news = empty_news(count, count * ways.migrants, fleet.champions.shape[1])
    send(ways, fleet, epoch, news)
    return dealt(fleet, news, islands), migrations(news)


@compiled
def send(ways: Routes, fleet: Fleet, epoch: int, news: News) -> None:
    """One exchange in place: see `migrate`. An edge writes one improvement at most."""
    words, fitness = fleet.words.copy(), fleet.fitness.copy()
    champions = fleet.champions.copy()
    discontinuities = fleet.search.fitness_discontinuities.copy()
    for e in range(ways.edges.shape[0]):
        source, destination = ways.edges[e, 0], ways.edges[e, 1]
        begin, end = fleet.first[source], fleet.first[source + 1]
        exact = ways.bits[source] == ways.bits[destination]
        known = fleet.search[destination]  # of the fitness, not of the place:
        known.fitness_discontinuities = max(known.fitness_discontinuities, discontinuities[source])
        for p in range(begin, min(end, begin + ways.migrants)):
            word = words[p : p + 1]
            if not exact:
                word = coded(decoded(word, ways.bits[source]), ways.bits[destination])
            if not _arrives(fleet, destination, word[0], fitness[p]):
                continue
            _settle(fleet, destination, word[0], fitness[p] if exact else np.nan)
            line = news.migrants[news.written[1]]
            line[0], line[1], line[2], line[3] = epoch, source, destination, fitness[p]
            news.written[1] += 1
            if exact and p == begin and fitness[p] < fleet.rms[destination]:
                _lead(fleet, destination, fitness[p], champions[source], news)


@compiled
def _arrives(fleet: Fleet, island: int, word: WordArray, fitness: float) -> bool:
    """Whether a migrant is fitter than the worst, and new here."""
    begin, end = fleet.first[island], fleet.first[island + 1]
    if not fitness < fleet.fitness[end - 1]:  # nan, not evaluated yet, comes last and is kept
        return False
    is_new = True
    for p in range(begin, end):
        is_new &= not np.all(fleet.words[p] == word)
    return is_new


@compiled
def _settle(fleet: Fleet, island: int, word: WordArray, fitness: float) -> None:
    """Put a migrant in the place of the worst individual."""
    begin, end = fleet.first[island], fleet.first[island + 1]
    for d in range(word.size):
        fleet.words[end - 1, d] = word[d]
    fleet.fitness[end - 1] = fitness
    rank(fleet.words[begin:end], fleet.fitness[begin:end])


@compiled
def _lead(fleet: Fleet, island: int, fitness: float, values: FloatArray, news: News) -> None:
    """Note that an island's champion has come from another."""
    search, row = fleet.search[island], news.improvements[news.written[0]]
    news.owners[news.written[0]] = island
    news.written[0] += 1
    write_improvement(search, fitness, MIGRATION, values, row)
    search.stagnation, search.champion_converged = 0, 0
    reset_evidence(search, fitness, fleet.rms[island])
    fleet.rms[island] = fitness
    for d in range(values.size):
        fleet.champions[island, d] = values[d]
