"""Operators of the genetic algorithm on chromosomes: rank, cross, mutate (Figure 4)."""

import numpy as np

from sysid.ga.random import below, unit
from sysid.kernels.caching import compiled
from sysid.types import FloatArray, IntArray, WordArray


@compiled
def rank(words: WordArray, fitness: FloatArray) -> None:
    """Sort a population in place, fittest first; equals keep their order.

    By insertion: populations are small, and after a generation half of them is in order.
    """
    n = words.shape[1]
    held = np.empty(n, np.uint32)
    for p in range(1, fitness.size):
        value, place = fitness[p], p
        if fitness[p - 1] <= value:
            continue
        for d in range(n):
            held[d] = words[p, d]
        while place > 0 and fitness[place - 1] > value:
            fitness[place] = fitness[place - 1]
            for d in range(n):
                words[place, d] = words[place - 1, d]
            place -= 1
        fitness[place] = value
        for d in range(n):
            words[place, d] = held[d]


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
    rate = float(rates[0])
    for i in range(starts.size):
        if starts[i] <= generation:
            rate = float(rates[i])
    return rate


@compiled
def reflected(place: float) -> float:
    """A place of at most one range outside, mirrored at the bound it has passed."""
    inside = abs(place)
    return inside if inside <= 1.0 else max(2.0 - inside, 0.0)


@compiled
def stepped(place: float, size: int, sign: int, bits: int) -> float:
    """Scale-free mutation: a step whose size is uniform in its logarithm, reflected at a bound.

    A flipped bit also changes a parameter by a power of two, but of the code, so that some
    neighbours are far apart (Hamming cliffs); a step on the axis has none.
    """
    step = float(2.0 ** (-unit(size) * bits))
    return reflected(place + (step if sign & 1 else -step))


@compiled
def two_of(a: int, b: int, n: int) -> tuple[int, int]:
    """Two different numbers below n (n ≥ 2) from two drawn words."""
    first = below(a, n)
    second = below(b, n - 1)
    return first, second + (1 if second >= first else 0)
