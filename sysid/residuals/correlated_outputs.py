"""Noise correlated over outputs: the middle of the sandwich with their covariance.

A disturbance of two sensors appears in both residuals and would count twice. Suppose that outputs
of an experiment are clearly correlated at the same times. Then Ω = E[Sᵀe eᵀS] gets the cross terms
Cov(eᵢ, eⱼ) (SᵢᵀSⱼ + SⱼᵀSᵢ) (Zellner 1962; the estimate keeps its weights). For coloured residuals
the coherence is assumed equal at all frequencies, with the spectra of `sysid.residuals.coloured`.
So the variance of a difference of outputs is never negative.

Equal residuals count once. So Σe² varies like that of fewer independent ones (Satterthwaite 1946):
n²/Σ r² of n, with the sum over all pairs. Two outputs with the same noise count as one.
"""

from collections.abc import Iterator
from itertools import combinations, groupby
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from sysid.core.distributions import chi_square_tail
from sysid.core.types import FloatArray, IntArray
from sysid.residuals.autocorrelation import MIN_SAMPLES, space_residuals
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
from sysid.residuals.repeats import estimate_repeat_covariance
from sysid.simulation.problem import Problem

_SIGNIFICANCE = 1e-3
"""Level of the test for correlation between outputs."""


class _SharedPart(NamedTuple):
    """A part at the times that it shares with another, and its rows among all samples."""

    part: ResidualPart
    rows: IntArray


class _CorrelatedPair(NamedTuple):
    """Two series at the same times, their correlation, and its p-value."""

    first: _SharedPart
    second: _SharedPart
    correlation: float
    chance: float


def estimate_joint_covariance(
    problem: Problem, influence: FloatArray, columns: FloatArray
) -> ColouredCovariance | None:
    """Estimate the coloured covariance with cross terms of outputs; None: one white noise.

    The series themselves are those of `estimate_coloured_covariance`. Samples pooled from repeats
    have the covariance of whole repeats.

    Parameters
    ----------
    influence : FloatArray, shape (n,)
        Influence of the weighted residuals of the scored samples on the loss.
    columns : FloatArray, shape (n, D)
        Sensitivities of these samples.
    """
    clustered = estimate_repeat_covariance(problem, influence, columns)
    if clustered is not None:
        return clustered
    pairs = (
        list(_find_correlated_pairs(problem, influence)) if len(problem.model.outputs) > 1 else []
    )
    whole = estimate_coloured_covariance(
        problem, influence, columns, by_model=not pairs
    )  # the same method for all series
    if not pairs:
        return whole
    if whole is None:
        white_middle = float(np.mean(np.square(influence))) * (columns.T @ columns)
        whole = ColouredCovariance(
            white_middle, float(influence.size), is_drifting=False, is_white=True
        )
    middle, double_counted = whole.middle, 0.0
    for pair in pairs:
        term = _compute_cross_term(pair, influence, columns, whole.is_white)
        middle = middle + term + term.T
        double_counted += 2.0 * pair.first.rows.size * pair.correlation**2
    size, vectors = np.linalg.eigh(middle)
    if size[0] < 0.0:  # if outputs with missing samples nearly cancel
        middle = (vectors * np.maximum(size, 0.0)) @ vectors.T
    share = 1.0 / (1.0 + double_counted / influence.size)
    return whole._replace(
        middle=middle,
        equivalent_samples=whole.equivalent_samples * share,
        series=tuple(
            (series_middle, max(share * degrees, 1.0)) for series_middle, degrees in whole.series
        ),
    )


def _find_correlated_pairs(problem: Problem, influence: FloatArray) -> Iterator[_CorrelatedPair]:
    """Find the pairs of outputs in experiments with common noise.

    All pairs of such an experiment count: a part of them might form an impossible covariance.
    """
    for _, group in groupby(iterate_parts(problem), key=attrgetter("experiment")):
        correlated = [
            _correlate_parts(first, second, influence) for first, second in combinations(group, 2)
        ]
        pairs = [pair for pair in correlated if pair is not None]
        if any(pair.chance < _SIGNIFICANCE / len(pairs) for pair in pairs):
            yield from pairs


def _correlate_parts(
    part_a: ResidualPart, part_b: ResidualPart, influence: FloatArray
) -> _CorrelatedPair | None:
    times, i, j = np.intersect1d(part_a.times, part_b.times, return_indices=True)
    if times.size < MIN_SAMPLES:
        return None
    first, second = (
        _SharedPart(part._replace(times=times), part.rows.start + indices)
        for part, indices in ((part_a, i), (part_b, j))
    )
    correlation = _compute_correlation(influence[first.rows], influence[second.rows])
    return None if correlation is None else _CorrelatedPair(first, second, *correlation)


def _compute_correlation(a: FloatArray, b: FloatArray) -> tuple[float, float] | None:
    """Compute the correlation of two series (n,) and its p-value; None if a series is 0.

    For series with poles p and q its variance is (1 + pq)/(1 - pq)/n (Bartlett 1935).
    """
    size = float(np.sqrt((a @ a) * (b @ b)))
    if not size > 0:
        return None
    correlation = float(a @ b) / size
    poles = float((a[1:] @ a[:-1]) * (b[1:] @ b[:-1]) / size**2)
    widening = (1.0 + max(poles, 0.0)) / (1.0 - max(poles, 0.0))
    return correlation, float(chi_square_tail(1, correlation**2 * a.size / widening))


def _compute_cross_term(
    pair: _CorrelatedPair, influence: FloatArray, columns: FloatArray, is_white: bool
) -> FloatArray:
    """Compute SᵢᵀE[eᵢeⱼᵀ]Sⱼ (D, D)."""
    parts = pair.first, pair.second
    errors, slopes = ([array[shared.rows] for shared in parts] for array in (influence, columns))
    have_colour = [
        not is_white and is_coloured(shared.part, error)
        for shared, error in zip(parts, errors, strict=True)
    ]
    if not any(have_colour):
        common = float(errors[0] @ errors[1]) / errors[0].size
        return np.asarray(common * (slopes[0].T @ slopes[1]))
    transformed = []
    for error, slope, has_colour in zip(errors, slopes, have_colour, strict=True):
        spaced = space_residuals(pair.first.part.times, error)
        root = estimate_spectrum_root(spaced)[0] if has_colour else make_white_root(spaced)
        transformed.append(transform_sensitivities(spaced, slope, root))
    return np.asarray(pair.correlation * (transformed[0] @ transformed[1].conj().T).real)
