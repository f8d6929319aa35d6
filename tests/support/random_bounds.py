"""How far a count or a mean of random draws may lie from what is claimed."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import binom, norm

from tests.support.profiles import PROFILE

FALSE_ALARM = 1e-4 if PROFILE == "night" else 1e-2
"""Probability that fresh seeds fail a program that is right; those of the gate are fixed."""


def bound_count(draws: int, lowest: float, highest: float | None = None) -> tuple[int, int]:
    """Return the least and the most events of `draws`, whose rate lies between these."""
    highest = lowest if highest is None else highest
    least = binom.ppf(FALSE_ALARM / 2, draws, lowest)
    return int(least), int(binom.isf(FALSE_ALARM / 2, draws, highest))


def bound_mean(values: ArrayLike, slack: float = 0.0) -> float:
    """Return how far the mean of independent values may lie from a claim true within `slack`."""
    found = np.asarray(values, dtype=np.float64)
    return float(slack + norm.isf(FALSE_ALARM / 2) * np.std(found, ddof=1) / np.sqrt(found.size))
