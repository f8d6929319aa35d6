"""Genetic operators on chromosomes (rank, cross, mutate; Figure 4), and their random numbers.

A chromosome has one unsigned word for each free parameter (Eq. 8, 9). Eq. 9 reads
θ = lower + (upper − lower)·int/(2^bits − 1). On a logarithmic scale the same rule holds for ln θ.
The *position* of a parameter is int/(2^bits − 1), a number in [0, 1]. The positions of all
parameters are a *point* of the unit cube.

Random numbers are a pure function of where they are used; no state is stored. The generator is
Philox4x32-10 (Salmon et al., *Parallel random numbers: as easy as 1, 2, 3*, SC 2011). Its key is
the run's seed, and its counter is (use, island, generation, draw). So an interrupted loop, or
another machine, draws the same numbers. No two uses share any.
"""

from typing import Any, TypeAlias

import numpy as np

from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray, IntArray, WordArray
from sysid.kernels.borrowing import compile_borrowing

RandomWords: TypeAlias = tuple[Any, Any, Any, Any]
"""Four independent words of 32 bits, as integers."""

# Uses of random numbers, one word of the counter.
USE_INITIAL = 1
USE_STRATA = 2
USE_CHILDREN = 3
USE_LOCAL_SEARCH = 4
USE_RESTART = 5
USE_WARM_START = 6

_MASK = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)


@jit_compile
def draw_words(seed: int, use: int, island: int, generation: int, draw: int) -> RandomWords:
    """Draw the four words of 32 bits that belong to a seed and a counter."""
    k0, k1 = np.uint64(seed) & _MASK, np.uint64(seed) >> _HALF
    c0, c1 = np.uint64(draw) & _MASK, np.uint64(generation) & _MASK
    c2, c3 = np.uint64(island) & _MASK, np.uint64(use) & _MASK
    for _ in range(10):
        p0, p1 = _MULTIPLIER_0 * c0, _MULTIPLIER_1 * c2
        c0, c1, c2, c3 = (p1 >> _HALF) ^ c1 ^ k0, p1 & _MASK, (p0 >> _HALF) ^ c3 ^ k1, p0 & _MASK
        k0, k1 = (k0 + _WEYL_0) & _MASK, (k1 + _WEYL_1) & _MASK
    return np.int64(c0), np.int64(c1), np.int64(c2), np.int64(c3)


@jit_compile
def to_uniform(word: int) -> float:
    """Convert a drawn word to a number in (0, 1)."""
    return (word + 0.5) / 4294967296.0


@jit_compile
def to_integer(word: int, n: int) -> int:
    """Convert a drawn word to an integer 0 … n − 1; n is far below 2³², so without bias."""
    return (word * n) >> 32


@jit_compile
def to_normal(word: RandomWords) -> float:
    """Compute a standard normal number from the first two of four drawn words."""
    return float(
        np.sqrt(-2.0 * np.log(to_uniform(word[0]))) * np.cos(2.0 * np.pi * to_uniform(word[1]))
    )


@compile_borrowing
def encode(points: FloatArray, bits: int) -> WordArray:
    """Encode points in [0, 1] as the nearest chromosomes."""
    largest = float((1 << bits) - 1)
    words = np.empty(points.shape, np.uint32)
    for p in range(points.shape[0]):
        for d in range(points.shape[1]):
            words[p, d] = np.uint32(round(min(max(points[p, d], 0.0), 1.0) * largest))
    return words


@compile_borrowing
def decode(words: WordArray, bits: int) -> FloatArray:
    """Decode chromosomes to points in [0, 1]; the inverse of `encode`."""
    largest = float((1 << bits) - 1)
    points = np.empty(words.shape)
    for p in range(words.shape[0]):
        for d in range(words.shape[1]):
            points[p, d] = words[p, d] / largest
    return points


@compile_borrowing
def sort_population(words: WordArray, fitness: FloatArray) -> None:
    """Sort a population in place, fittest first; equal ones keep their order.

    Insertion sort: populations are small, and half of them is in order after a generation.
    """
    order, is_sorted = np.empty(fitness.size, np.int64), True
    for p in range(fitness.size):
        value, index = fitness[p], p
        while index > 0 and fitness[index - 1] > value:
            fitness[index], order[index] = fitness[index - 1], order[index - 1]
            index, is_sorted = index - 1, False
        fitness[index], order[index] = value, p
    if is_sorted:
        return
    before = words.copy()
    for p in range(fitness.size):
        for d in range(words.shape[1]):
            words[p, d] = before[order[p], d]


@jit_compile
def cross_over(child: WordArray, first: WordArray, second: WordArray, cut: int, bits: int) -> None:
    """Cross over the bit strings at one point: `cut` bits of `first`, the rest of `second`.

    The bit string consists of the words in order, each from its highest bit.
    """
    for d in range(child.size):
        taken = min(max(cut - d * bits, 0), bits)
        low = np.uint32((1 << (bits - taken)) - 1)
        child[d] = (first[d] & ~low) | (second[d] & low)


@jit_compile
def flip_bit(child: WordArray, position: int, bits: int) -> None:
    """Mutate one bit of the string."""
    child[position // bits] ^= np.uint32(1 << (bits - 1 - position % bits))


@jit_compile
def get_mutation_rate(starts: IntArray, rates: FloatArray, generation: int) -> float:
    """Get the mutation rate at a generation from the schedule."""
    rate = float(rates[0])
    for i in range(starts.size):
        if starts[i] <= generation:
            rate = float(rates[i])
    return rate


@jit_compile
def reflect_at_bounds(position: float) -> float:
    """Reflect a position, at most one range outside, at the bound that it has passed."""
    inside = abs(position)
    return inside if inside <= 1.0 else max(2.0 - inside, 0.0)


@jit_compile
def mutate_by_step(position: float, size: int, sign: int, bits: int) -> float:
    """Mutate by a scale-free step: its size is log-uniform, and it is reflected at a bound.

    A flipped bit also changes the code by a power of two, but some neighbouring values differ in
    many bits (Hamming cliffs). A step on the axis has no such cliffs.
    """
    step = float(2.0 ** (-to_uniform(size) * bits))
    return reflect_at_bounds(position + (step if sign & 1 else -step))


@jit_compile
def draw_pair(a: int, b: int, n: int) -> tuple[int, int]:
    """Draw two different numbers below n (n ≥ 2) from two words."""
    first = to_integer(a, n)
    second = to_integer(b, n - 1)
    return first, second + (1 if second >= first else 0)
