"""Correlations and their covariances against the sums of their definitions, written out."""

import numpy as np
import pytest
from scipy.linalg import toeplitz

from sysid.core.types import BoolArray, FloatArray
from sysid.data.records import Channel
from sysid.residuals.autocorrelation import (
    compute_lagged_sums,
    compute_whiteness,
    smooth_spectrum_root,
    space_residuals,
)

N = 120
TIMES = 0.5 * np.arange(N)


def colour_noise(seed: int) -> FloatArray:
    noise = np.random.default_rng(seed).normal(size=N)
    for k in range(1, N):
        noise[k] += 0.6 * noise[k - 1]
    return noise


def gaps(share: float) -> BoolArray:
    present = np.random.default_rng(9).random(N) >= share
    present[[0, -1]] = True
    return present


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_the_statistic_of_whiteness_is_that_of_ljung_and_box(share: float) -> None:
    present, e = gaps(share), colour_noise(0)
    spaced = space_residuals(TIMES[present], e[present])
    e, n = np.where(present, e, 0.0), np.count_nonzero(present)
    found, statistic = compute_whiteness(spaced), 0.0
    for lag in range(1, spaced.n_lags + 1):
        pairs = np.count_nonzero(present[lag:] & present[:-lag])
        r = float(e[lag:] @ e[:-lag]) / float(e @ e)
        assert found.values[lag - 1] == pytest.approx(r)
        assert found.deviation[lag - 1] == pytest.approx(np.sqrt(pairs / (n * (n + 2))))
        statistic += n * (n + 2) * r**2 / pairs
    assert found.statistic == pytest.approx(statistic)


def weigh_autocovariance(e: FloatArray, present: BoolArray) -> FloatArray:
    """Autocovariance (N,) in a Parzen window of Andrews' width, without missing samples."""
    n = e.size
    pairs = np.array([np.count_nonzero(present[k:] & present[: n - k]) for k in range(n)])
    sums = np.array([e[k:] @ e[: n - k] for k in range(n)])
    rho = sums[1] * (n - 1) / pairs[1] / (sums[0] * n / pairs[0])
    width = 2.66 * (4 * rho**2 / (1 - rho) ** 4 * n) ** 0.2
    x = np.minimum(np.arange(n) / width, 1.0)
    window = np.where(x <= 0.5, 1 - 6 * x**2 * (1 - x), 2 * (1 - x) ** 3)
    counted = np.where(pairs > 0, np.arange(n, 0, -1) / np.maximum(pairs, 1), 0.0)
    return np.asarray(window * counted * sums / n)


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_the_covariance_of_two_sums_is_that_of_the_windowed_autocovariance(share: float) -> None:
    present = gaps(share)
    e = np.where(present, colour_noise(1), 0.0)
    u = np.random.default_rng(2).normal(size=N + 20)
    channel = Channel("u", 0.5 * (np.arange(N + 20) - 20), u)
    spaced = space_residuals(TIMES[present], e[present])
    lags = np.array([0.0, 1.0, 5.0, 17.0])
    sums = compute_lagged_sums(spaced, e, smooth_spectrum_root(e, present), channel, lags)
    assert not isinstance(sums, str)
    columns = np.array([u[20 - int(lag) : 20 - int(lag) + N] for lag in lags])
    columns = np.where(present, columns, 0.0)
    columns -= np.outer(columns.sum(axis=1) / np.count_nonzero(present), present)
    dense = columns @ toeplitz(weigh_autocovariance(e, present)) @ columns.T
    np.testing.assert_allclose(sums.sums, columns @ e)
    np.testing.assert_allclose(sums.covariance, dense, rtol=1e-6, atol=1e-6 * np.max(dense))
    np.testing.assert_allclose(sums.deviation, np.sqrt(np.diag(dense)), rtol=1e-6)
    norm = np.sqrt(np.sum(columns**2, axis=1) * (e @ e))
    np.testing.assert_allclose(sums.norm, norm)
