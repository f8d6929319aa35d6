"""Memory of fitness: an individual that was simulated before is not simulated again.

A population that has converged breeds the same chromosomes again and again. Of the children of a
simple genetic search two thirds are known. Their fitness is the same to the last bit, so the
memory changes nothing but the time.
"""

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray, WordArray
from sysid.kernels.borrowing import compile_borrowing
from sysid.search.state import KnownFitness

_INDEX_BITS = 10
_MIX = np.uint64(0x9E3779B97F4A7C15)
_SHIFT = np.uint64(64 - _INDEX_BITS)


@jit_compile
def make_known_fitness(islands: int, n: int) -> KnownFitness:
    """Make the empty memories of some islands, one behind the other, for `n` words."""
    size = islands << _INDEX_BITS
    return KnownFitness(np.empty((size, n), np.uint32), np.full(size, np.nan))


@jit_compile
def get_island_memory(known: KnownFitness, i: int) -> KnownFitness:
    """Return the memory of one island; it is empty if there is none."""
    begin, end = i << _INDEX_BITS, (i + 1) << _INDEX_BITS
    return KnownFitness(known.words[begin:end], known.fitness[begin:end])


@jit_compile
def _locate(chromosome: WordArray) -> int:
    mixed = np.uint64(0)
    for d in range(chromosome.size):
        mixed = (mixed ^ np.uint64(chromosome[d])) * _MIX
    return int(mixed >> _SHIFT)


@compile_borrowing
def recall_fitness(known: KnownFitness, chromosomes: WordArray, fitness: FloatArray) -> None:
    """Replace ``nan`` by the fitness of each chromosome (P, D) that is known."""
    for p in range(fitness.size if known.fitness.size else 0):
        if np.isnan(fitness[p]):
            index, is_same = _locate(chromosomes[p]), True
            for d in range(chromosomes.shape[1]):
                is_same &= known.words[index, d] == chromosomes[p, d]
            if is_same:
                fitness[p] = known.fitness[index]


@compile_borrowing
def remember_fitness(known: KnownFitness, chromosomes: WordArray, fitness: FloatArray) -> None:
    """Store the fitness (P,) of chromosomes (P, D)."""
    for p in range(fitness.size if known.fitness.size else 0):
        index = _locate(chromosomes[p])
        known.fitness[index] = fitness[p]
        for d in range(chromosomes.shape[1]):
            known.words[index, d] = chromosomes[p, d]
