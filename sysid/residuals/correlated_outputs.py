"""Noise that several outputs have in common: the sandwich's middle with their covariance in it.

What shakes two sensors at once shows in both residuals, and is told twice. Where outputs of an
experiment are clearly correlated at the same times, Ω = E[Sᵀe eᵀS] gets the terms of both,
Cov(eᵢ, eⱼ) (SᵢᵀSⱼ + SⱼᵀSᵢ) (Zellner 1962; the estimate stays that of the weights). Of coloured
residuals their coherence is taken to be the same at all frequencies, beside the spectra that
`sysid.residuals.coloured` has of each: so the variance of what the noise leaves of a difference is
never below 0.

Residuals alike count once. So Σe² varies as that of fewer independent ones (Satterthwaite 1946):
of n that n²/Σ r², over all pairs of them; of two outputs with the same noise that is one's.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, islice
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from sysid.core.types import FloatArray, IntArray
from sysid.residuals.autocorrelation import FEWEST_SAMPLES, space_residuals
from sysid.residuals.coloured import (
    ColouredCovariance,
    ResidualPart,
    estimate_coloured_covariance,
    estimate_spectrum_root,
    is_coloured,
    iterate_parts,
    make_white_root,
    transform_sensitivities,
)
from sysid.simulation.problem import Problem

_SIGNIFICANCE = 1e-3
"""That residuals without anything in common look as correlated: below, they are taken to have."""


class _SharedPart(NamedTuple):
    """A part at the times that it shares with another, and its rows among all samples."""

    part: ResidualPart
    rows: IntArray


class _CorrelatedPair(NamedTuple):
    """Two series at the same times, their correlation, and its chance if it were none."""

    first: _SharedPart
    second: _SharedPart
    correlation: float
    chance: float


def estimate_joint_covariance(
    problem: Problem, seen: FloatArray, columns: FloatArray
) -> ColouredCovariance | None:
    """What `estimate_coloured_covariance` gives, with the covariance of outputs; None: one white noise.

    Parameters
    ----------
    seen : FloatArray, shape (n,)
        Weighted residuals of the scored samples as the loss sees them.
    columns : FloatArray, shape (n, D)
        Their sensitivities.
    """
    pairs = list(_find_correlated_pairs(problem, seen)) if len(problem.model.outputs) > 1 else []
    whole = estimate_coloured_covariance(
        problem, seen, columns, by_model=not pairs
    )  # of all by the same means
    if not pairs:
        return whole
    if whole is None:
        alone = float(np.mean(np.square(seen))) * (columns.T @ columns)
        whole = ColouredCovariance(alone, float(seen.size), is_drifting=False, is_white=True)
    middle, twice = whole.middle, 0.0
    for pair in pairs:
        term = _compute_cross_term(pair, seen, columns, whole.is_white)
        middle = middle + term + term.T
        twice += 2.0 * pair.first.rows.size * pair.correlation**2
    size, vectors = np.linalg.eigh(middle)
    if size[0] < 0.0:  # where outputs that are not measured all the time nearly cancel out
        middle = (vectors * np.maximum(size, 0.0)) @ vectors.T
    counted = 1.0 / (1.0 + twice / seen.size)
    return whole._replace(
        middle=middle,
        equivalent_samples=whole.equivalent_samples * counted,
        series=tuple((one, max(counted * degrees, 1.0)) for one, degrees in whole.series),
    )


def _find_correlated_pairs(problem: Problem, seen: FloatArray) -> Iterator[_CorrelatedPair]:
    """The pairs of outputs of those experiments that have a noise in common.

    All of them: some alone might have correlations that no noise has.
    """
    for group in _group_by_experiment(problem):
        found = [_correlate_parts(one, other, seen) for one, other in combinations(group, 2)]
        known = [pair for pair in found if pair is not None]
        if any(pair.chance < _SIGNIFICANCE / len(known) for pair in known):
            yield from known


def _correlate_parts(
    one: ResidualPart, other: ResidualPart, seen: FloatArray
) -> _CorrelatedPair | None:
    times, i, j = np.intersect1d(one.times, other.times, return_indices=True)
    if times.size < FEWEST_SAMPLES:
        return None
    first, second = (
        _SharedPart(part._replace(times=times), part.rows.start + at)
        for part, at in ((one, i), (other, j))
    )
    found = _compute_correlation(seen[first.rows], seen[second.rows])
    return None if found is None else _CorrelatedPair(first, second, *found)


def _group_by_experiment(problem: Problem) -> Iterator[Sequence[ResidualPart]]:
    every = iterate_parts(problem)
    for weight in problem.split_by_output(problem.evaluator.weight):
        yield tuple(islice(every, sum(bool(np.any(one > 0)) for one in weight.values())))


def _compute_correlation(a: FloatArray, b: FloatArray) -> tuple[float, float] | None:
    """The correlation of two series (n,), and the chance that it is by chance; None: one is 0.

    Of series with poles p and q its variance is (1 + pq)/(1 - pq)/n (Bartlett 1935).
    """
    size = float(np.sqrt((a @ a) * (b @ b)))
    if not size > 0:
        return None
    found = float(a @ b) / size
    poles = float((a[1:] @ a[:-1]) * (b[1:] @ b[:-1]) / size**2)
    widening = (1.0 + max(poles, 0.0)) / (1.0 - max(poles, 0.0))
    return found, float(chdtrc(1, found**2 * a.size / widening))


def _compute_cross_term(
    pair: _CorrelatedPair, seen: FloatArray, columns: FloatArray, is_white: bool
) -> FloatArray:
    """SᵢᵀE[eᵢeⱼᵀ]Sⱼ (D, D)."""
    both = pair.first, pair.second
    errors, slopes = ([of[one.rows] for one in both] for of in (seen, columns))
    have_colour = [
        not is_white and is_coloured(one.part, error)
        for one, error in zip(both, errors, strict=True)
    ]
    if not any(have_colour):
        common = float(errors[0] @ errors[1]) / errors[0].size
        return np.asarray(common * (slopes[0].T @ slopes[1]))
    moved = []
    for error, slope, has_colour in zip(errors, slopes, have_colour, strict=True):
        laid = space_residuals(pair.first.part.times, error)
        root = estimate_spectrum_root(laid)[0] if has_colour else make_white_root(laid)
        moved.append(transform_sensitivities(laid, slope, root))
    return np.asarray(pair.correlation * (moved[0] @ moved[1].conj().T).real)
