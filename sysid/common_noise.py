"""Noise that several outputs have in common: the sandwich's middle with their covariance in it.

What shakes two sensors at once shows in both residuals, and is told twice. Where outputs of an
experiment are clearly correlated at the same times, Ω = E[Sᵀe eᵀS] gets the terms of both,
Cov(eᵢ, eⱼ) (SᵢᵀSⱼ + SⱼᵀSᵢ) (Zellner 1962; the estimate stays that of the weights). Of coloured
residuals their coherence is taken to be the same at all frequencies.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, islice
from typing import NamedTuple

import numpy as np
from numpy.fft import rfft
from scipy.special import chdtrc

from sysid.lagged_sums import FEWEST, colour_of
from sysid.problem import Problem
from sysid.serial import Coloured, Part, coloured, parts
from sysid.types import FloatArray, IntArray

_CHANCE = 1e-3
"""That residuals without anything in common look as correlated: below, they are taken to have."""


class _Pair(NamedTuple):
    """Two series with something in common: the rows of the same times, and their correlation."""

    first: IntArray
    second: IntArray
    correlation: float


def coloured_jointly(problem: Problem, seen: FloatArray, columns: FloatArray) -> Coloured | None:
    """What `coloured` gives, with the covariance of outputs; None: one white noise.

    Parameters
    ----------
    seen : FloatArray, shape (n,)
        Weighted residuals of the scored samples as the loss sees them.
    columns : FloatArray, shape (n, D)
        Their sensitivities.
    """
    whole = coloured(problem, seen, columns)
    pairs = list(_pairs(problem, seen)) if len(problem.model.outputs) > 1 else []
    if not pairs:
        return whole
    if whole is None:
        alone = float(np.mean(np.square(seen))) * (columns.T @ columns)
        whole = Coloured(alone, float(seen.size), drifts=False, is_white=True)
    middle = whole.middle
    for pair in pairs:
        term = _cross(pair, seen, columns, whole.is_white)
        middle = middle + term + term.T
    return whole._replace(middle=middle)


def _pairs(problem: Problem, seen: FloatArray) -> Iterator[_Pair]:
    for group in _by_experiment(problem):
        for one, other in combinations(group, 2):
            _, i, j = np.intersect1d(one.times, other.times, return_indices=True)
            first, second = one.rows.start + i, other.rows.start + j
            if first.size >= FEWEST:
                correlation = _correlation(seen[first], seen[second])
                if correlation is not None:
                    yield _Pair(first, second, correlation)


def _by_experiment(problem: Problem) -> Iterator[Sequence[Part]]:
    every = parts(problem)
    for weight in problem.split(problem.evaluator.weight):
        yield tuple(islice(every, sum(bool(np.any(one > 0)) for one in weight.values())))


def _correlation(a: FloatArray, b: FloatArray) -> float | None:
    """The correlation of two series (n,) if it is clear, else None.

    Of series with poles p and q its variance is (1 + pq)/(1 - pq)/n (Bartlett 1935).
    """
    size = float(np.sqrt((a @ a) * (b @ b)))
    if not size > 0:
        return None
    found = float(a @ b) / size
    poles = float((a[1:] @ a[:-1]) * (b[1:] @ b[:-1]) / size**2)
    widening = (1.0 + max(poles, 0.0)) / (1.0 - max(poles, 0.0))
    chance = float(chdtrc(1, found**2 * a.size / widening))
    return found if chance < _CHANCE else None


def _cross(pair: _Pair, seen: FloatArray, columns: FloatArray, is_white: bool) -> FloatArray:
    """SᵢᵀE[eᵢeⱼᵀ]Sⱼ (D, D)."""
    one, other = columns[pair.first], columns[pair.second]
    if is_white:
        common = float(seen[pair.first] @ seen[pair.second]) / pair.first.size
        return np.asarray(common * (one.T @ other))
    moved = (_moved(one, seen[pair.first]), _moved(other, seen[pair.second]))
    return np.asarray(pair.correlation * (moved[0] @ moved[1].conj().T).real)


def _moved(columns: FloatArray, residual: FloatArray) -> FloatArray:
    """Transforms (D, F) of sensitivities, times the root of the residuals' spectrum."""
    n = residual.size
    root = colour_of(residual, np.ones(n, dtype=np.bool_), room=n)
    return np.asarray(rfft(columns.T, 2 * (root.size - 1), axis=1) * root)
