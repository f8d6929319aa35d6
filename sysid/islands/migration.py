"""Migration: copies of the best of one island replace the worst of another, all at once."""

import numpy as np

from sysid.ga.chromosome import coded, decoded
from sysid.ga.island import Island
from sysid.ga.state import CLIFFS, CONFIRMED, HOPS, RETURNED, SAME, SETTLED, STAGNATION
from sysid.islands.topology import edges
from sysid.result import Improvement, Migrant
from sysid.settings import Migration
from sysid.types import IntArray, WordArray


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
    if not fitness < island.fitness[-1]:  # nan, not evaluated yet, comes last and is kept
        return False
    sought, there = word.tobytes(), island.words.tobytes()
    return all(there[i : i + len(sought)] != sought for i in range(0, len(there), len(sought)))


def _with(
    island: Island, word: WordArray, fitness: float, values: tuple[float, ...] | None
) -> Island:
    """The island with a migrant in the place of its worst individual."""
    words, reached = island.words.copy(), island.fitness.copy()
    words[-1], reached[-1] = word, fitness
    order = np.argsort(reached, kind="stable")
    counters, history = island.counters, island.history
    if values is not None and fitness < island.champion_rms:
        better = Improvement(island.generation, island.evaluations, fitness, "migration", values)
        history, counters = (*history, better), _of_another(island, fitness)
    return Island(
        island.index, island.seed, words[order], reached[order], counters, island.memory, history
    )


def _of_another(island: Island, fitness: float) -> IntArray:
    """The counters of an island whose champion has come from another."""
    counters = island.counters.copy()
    counters[STAGNATION], counters[SETTLED] = 0, 0
    if fitness < island.champion_rms * (1.0 - SAME):
        counters[CONFIRMED], counters[CLIFFS] = 0, 0
        counters[HOPS], counters[RETURNED] = 0, 0
    return counters
