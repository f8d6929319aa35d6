"""Random numbers as a pure function of where they are used: counter-based, nothing is stored.

The generator is Philox4x32-10 (Salmon et al., *Parallel random numbers: as easy as 1, 2, 3*,
SC 2011). Its key is the run's seed, its counter (use, island, generation, draw). So a loop that
is cut anywhere, or runs on another machine, draws the same numbers, and no two uses share any.
"""

from typing import Any, TypeAlias

import numpy as np

from sysid.kernels.caching import compiled

Draws: TypeAlias = tuple[Any, Any, Any, Any]
"""Four independent words of 32 bits, as whole numbers."""

# Uses of random numbers: the first word of the counter.
INITIAL, STRATA, CHILDREN, DEVELOPMENT, RESTART, WARM = 1, 2, 3, 4, 5, 6

_MASK = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)


@compiled
def draws(seed: int, use: int, island: int, generation: int, draw: int) -> Draws:
    """Four words of 32 bits that belong to this place of this run."""
    k0, k1 = np.uint64(seed) & _MASK, np.uint64(seed) >> _HALF
    c0, c1 = np.uint64(draw) & _MASK, np.uint64(generation) & _MASK
    c2, c3 = np.uint64(island) & _MASK, np.uint64(use) & _MASK
    for _ in range(10):
        p0, p1 = _MULTIPLIER_0 * c0, _MULTIPLIER_1 * c2
        c0, c1, c2, c3 = (p1 >> _HALF) ^ c1 ^ k0, p1 & _MASK, (p0 >> _HALF) ^ c3 ^ k1, p0 & _MASK
        k0, k1 = (k0 + _WEYL_0) & _MASK, (k1 + _WEYL_1) & _MASK
    return np.int64(c0), np.int64(c1), np.int64(c2), np.int64(c3)


@compiled
def unit(word: int) -> float:
    """A drawn word as a number in (0, 1)."""
    return (word + 0.5) / 4294967296.0


@compiled
def below(word: int, n: int) -> int:
    """A drawn word as a whole number 0 … n − 1 (n is far below 2³², so the bias is nil)."""
    return (word * n) >> 32


@compiled
def normal(word: Draws) -> float:
    """A normal number of standard deviation 1 from the first two of four drawn words."""
    return float(np.sqrt(-2.0 * np.log(unit(word[0]))) * np.cos(2.0 * np.pi * unit(word[1])))
