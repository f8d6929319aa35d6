"""Operators of the genetic algorithm on chromosomes: rank, cross, mutate (Figure 4)."""

import numpy as np

from sysid.ga.random import below, unit
from sysid.kernels.calls import compiled
from sysid.types import FloatArray, IntArray, WordArray


@compiled
def rank(words: WordArray, fitness: FloatArray) -> None:
    """Sort a population in place, fittest first; equals keep their order."""
    order = np.argsort(fitness, kind="mergesort")
    words[:] = words[order]
    fitness[:] = fitness[order]


@compiled
def cross(child: WordArray, first: WordArray, second: WordArray, cut: int, bits: int) -> None:
    """One-point crossover of the whole bit string: `cut` bits of `first`, the rest of `second`.

    The string is the words one after the other, each from its highest bit.
    """
    for d in range(child.size):
        taken = min(max(cut - d * bits, 0), bits)
        low = np.uint32((1 << (bits - taken)) - 1)
        child[d] = (first[d] & ~low) | (second[d] & low)


@compiled
def flip(child: WordArray, position: int, bits: int) -> None:
    """Mutation: one bit of the string changes."""
    child[position // bits] ^= np.uint32(1 << (bits - 1 - position % bits))


@compiled
def scheduled(starts: IntArray, rates: FloatArray, generation: int) -> float:
    """Mutation rate at a generation: that of the last entry that has begun."""
    rate = rates[0]
    for i in range(starts.size):
        if starts[i] <= generation:
            rate = rates[i]
    return rate


@compiled
def stepped(place: float, size: int, sign: int, bits: int) -> float:
    """Scale-free mutation: a step whose size is uniform in its logarithm, reflected at a bound.

    A flipped bit also changes a parameter by a power of two, but of the code, so that some
    neighbours are far apart (Hamming cliffs); a step on the axis has none.
    """
    step = 2.0 ** (-unit(size) * bits)
    moved = abs(place + (step if sign & 1 else -step))
    return moved if moved <= 1.0 else 2.0 - moved


@compiled
def two_of(a: int, b: int, n: int) -> tuple[int, int]:
    """Two different numbers below n (n ≥ 2) from two drawn words."""
    first = below(a, n)
    second = below(b, n - 1)
    return first, second + (1 if second >= first else 0)
