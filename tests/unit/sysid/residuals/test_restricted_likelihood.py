"""The colour of short records by restricted likelihood, against dense matrices and repetition."""

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter
from scipy.special import chdtrc

from sysid.core.types import FloatArray
from sysid.residuals.autocorrelation import SpacedResiduals, compute_whiteness, space_residuals
from sysid.residuals.restricted_likelihood import (
    _compute_deviance,
    _compute_middle,
    _ObservedSeries,
    _to_pole_and_share,
    fit_noise_colour,
)
from sysid.residuals.series import ResidualPart, is_coloured
from tests.support.profiles import draw_seeds

PLACES = [(0.5, -1.0), (1.3, 0.4), (-0.6, -3.0)]


def slow(n: int, pole: float, seed: int, white: float = 0.0) -> FloatArray:
    """First-order noise beside white noise of that share, of variance 1."""
    own, other = np.random.default_rng(seed).standard_normal((2, n + 200))
    found = lfilter([np.sqrt(1 - pole**2)], [1, -pole], own)[200:]
    return np.asarray(np.sqrt(1 - white) * found + np.sqrt(white) * other[200:])


def make_regressors(n: int) -> FloatArray:
    """A level, a slope and a wave."""
    x = np.linspace(-1, 1, n)
    return np.column_stack([np.ones(n), x, np.sin(3 * x)])


def compute_residuals(values: FloatArray, columns: FloatArray) -> FloatArray:
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0])


def with_gaps(n: int = 60) -> tuple[SpacedResiduals, FloatArray, FloatArray]:
    """A series with samples missing, its sensitivities, and the times of the others."""
    kept = np.sort(np.random.default_rng(2).permutation(n)[: n - 12])
    columns = make_regressors(n)[kept]
    values = compute_residuals(slow(n, 0.7, 1)[kept], columns)
    return space_residuals(kept.astype(np.float64), values), columns, kept.astype(np.float64)


def dense(place: tuple[float, float], times: FloatArray) -> FloatArray:
    a, w = _to_pole_and_share(np.array(place))
    gaps = np.abs(times[:, None] - times).astype(int)
    return np.asarray(np.where(gaps == 0, 1.0, (1 - w) * a**gaps))


@pytest.mark.parametrize("place", PLACES)
def test_the_likelihood_is_that_of_combinations_without_the_parameters(
    place: tuple[float, float],
) -> None:
    laid, columns, times = with_gaps()
    basis = np.linalg.svd(columns, full_matrices=False)[0]
    values = laid.values[laid.present]
    series = _ObservedSeries(values, basis, np.diff(times).astype(np.int64))
    free = np.linalg.svd(columns)[0][:, 3:]  # orthogonal to all sensitivities

    def compute_expected(at: tuple[float, float]) -> float:
        inner = free.T @ dense(at, times) @ free
        told = free.T @ values
        power = float(told @ np.linalg.solve(inner, told))
        return float(free.shape[1] * np.log(power) + np.linalg.slogdet(inner)[1])

    other = PLACES[1]
    assert _compute_deviance(np.array(place), series) - _compute_deviance(
        np.array(other), series
    ) == pytest.approx(compute_expected(place) - compute_expected(other), abs=1e-8)


@pytest.mark.parametrize("place", PLACES)
def test_the_middle_is_that_of_the_whole_matrix_over_gaps_too(place: tuple[float, float]) -> None:
    laid, columns, times = with_gaps()
    basis = np.linalg.svd(columns, full_matrices=False)[0]
    values = laid.values[laid.present]
    series = _ObservedSeries(values, basis, np.diff(times).astype(np.int64))
    matrix = dense(place, times)
    inverse = np.linalg.inv(matrix)
    gram = columns.T @ inverse @ columns
    left = values - columns @ np.linalg.solve(gram, columns.T @ inverse @ values)
    variance = float(left @ inverse @ left) / (values.size - 3)
    spaced_columns = np.zeros((laid.values.size, 3))
    spaced_columns[laid.present] = columns
    np.testing.assert_allclose(
        _compute_middle(np.array(place), spaced_columns, series),
        variance * columns.T @ matrix @ columns,
        rtol=1e-8,
        atol=1e-10,
    )


def test_variances_are_on_average_those_of_the_noise_though_residuals_are_less() -> None:
    """Of sixty samples with three parameters; from the residuals' own sums it would be half."""
    n, pole = 60, 0.7
    columns, times = make_regressors(n), np.arange(60.0)
    truth = np.diag(columns.T @ toeplitz(pole ** np.arange(n)) @ columns)
    found, plain, seeds = [], [], draw_seeds(gate=50, night=600)
    for seed in seeds:
        left = compute_residuals(slow(n, pole, seed), columns)
        known = fit_noise_colour(space_residuals(times, left), columns)
        if known is not None:
            found.append(np.diag(known.middle) / truth)
        sums = np.correlate(left, left, "full")[n - 1 :] / n
        window = np.where(np.arange(n) < 15, 1 - np.arange(n) / 15, 0.0)
        plain.append(np.diag(columns.T @ toeplitz(sums * window) @ columns) / truth)
    assert len(found) > 0.87 * len(seeds)
    assert np.all(np.abs(np.median(found, axis=0) - 1.0) < 0.3)
    assert np.median(plain) < 0.6


def test_what_is_no_first_order_noise_is_not_taken_for_one() -> None:
    white = np.random.default_rng(0).standard_normal(400)
    ringing = lfilter([1.0], [1.0, -1.4, 0.85], white)[200:]
    columns = make_regressors(200)
    laid = space_residuals(np.arange(200.0), compute_residuals(ringing, columns))
    assert fit_noise_colour(laid, columns) is None
    assert (
        fit_noise_colour(space_residuals(np.arange(4.0), slow(4, 0.5, 0)), make_regressors(4))
        is None
    )


def test_the_slower_the_noise_the_fewer_degrees_of_freedom() -> None:
    columns, times = make_regressors(100), np.arange(100.0)
    degrees = []
    for pole in (0.3, 0.8):
        each = [
            fit_noise_colour(
                space_residuals(times, compute_residuals(slow(100, pole, s), columns)), columns
            )
            for s in draw_seeds(gate=15, night=200)
        ]
        level = np.array([1.0, 0.0, 0.0])
        degrees.append(
            np.median([2 / one.compute_variation(level) for one in each if one is not None])
        )
    assert degrees[1] < 0.5 * degrees[0] < 50


def test_short_slow_noise_is_recognised_by_its_neighbours_and_white_noise_no_more_often() -> None:
    columns, times = make_regressors(100), np.arange(100.0)
    part = ResidualPart(0, "y", slice(0, 100), times, 1.0)
    counts, seeds = [], draw_seeds(gate=200, night=2000)
    for pole in (0.5, 0.0):
        every = [
            space_residuals(times, compute_residuals(slow(100, pole, s), columns)) for s in seeds
        ]
        by_all = sum(chdtrc(one.n_lags, compute_whiteness(one).statistic) < 1e-3 for one in every)
        seen = sum(is_coloured(part, one.values) for one in every)
        counts.append((seen, by_all))
    (slow_seen, slow_by_all), (white_seen, white_by_all) = counts
    assert slow_seen > 0.8 * len(seeds) > slow_by_all
    assert white_seen <= white_by_all + 0.005 * len(seeds)
