"""Migration: copies of the best of one island replace the worst of another, all at once."""

from dataclasses import replace

import numpy as np

from sysid.ga.chromosome import coded, decoded
from sysid.ga.island import Island
from sysid.ga.state import SETTLED, STAGNATION
from sysid.islands.topology import edges
from sysid.result import Improvement, Migrant
from sysid.settings import Migration
from sysid.types import WordArray


def migrate(
    islands: tuple[Island, ...], bits: tuple[int, ...], migration: Migration, epoch: int
) -> tuple[tuple[Island, ...], tuple[Migrant, ...]]:
    """The islands after one exchange, and its log.

    Synchronous: every island sends what it had before the exchange. A migrant replaces the
    receiver's worst individual only if it is fitter and not there already, so no island gets
    worse. `bits` are those of each island; between islands that differ the nearest chromosome
    arrives, to be evaluated at its destination.
    """
    received = list(islands)
    log: list[Migrant] = []
    for source, destination in edges(migration.topology, len(islands)):
        giver = islands[source]
        for p in range(min(migration.migrants, giver.fitness.size)):
            word, fitness = giver.words[p], float(giver.fitness[p])
            exact = bits[source] == bits[destination]
            if not exact:
                word = coded(decoded(word[None], bits[source]), bits[destination])[0]
            if _arrives(received[destination], word, fitness):
                values = giver.history[-1].parameters if exact and p == 0 else None
                received[destination] = _with(
                    received[destination], word, fitness if exact else np.nan, values
                )
                log.append(Migrant(epoch, source, destination, fitness))
    return tuple(received), tuple(log)


def _arrives(island: Island, word: WordArray, fitness: float) -> bool:
    """Whether a migrant is fitter than the worst, and new here."""
    worst = np.max(island.fitness)  # nan, not evaluated yet, is never replaced
    return bool(fitness < worst) and not bool(np.any(np.all(island.words == word, axis=1)))


def _with(
    island: Island, word: WordArray, fitness: float, values: tuple[float, ...] | None
) -> Island:
    """The island with a migrant in the place of its worst individual."""
    words, reached = island.words.copy(), island.fitness.copy()
    words[-1], reached[-1] = word, fitness
    order = np.argsort(reached, kind="stable")
    moved = replace(island, words=words[order], fitness=reached[order])
    if values is None or not fitness < island.champion_rms:
        return moved
    counters = island.counters.copy()
    counters[STAGNATION], counters[SETTLED] = 0, 0
    better = Improvement(island.generation, island.evaluations, fitness, "migration", values)
    return replace(moved, counters=counters, history=(*island.history, better))
