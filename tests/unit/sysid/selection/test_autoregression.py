"""Autoregressive noise: its order, its coefficients, and what is left of it."""

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.selection.autoregression import Autoregression, fit_autoregression


def make_noise(coefficients: list[float], samples: int, seed: int) -> FloatArray:
    white = np.random.default_rng(seed).standard_normal(samples + 100)
    values = np.zeros(samples + 100)
    for k in range(len(coefficients), values.size):
        past = sum(a * values[k - lag] for lag, a in enumerate(coefficients, 1))
        values[k] = past + white[k]
    return values[100:]


def test_the_coefficients_are_found_in_several_series() -> None:
    parts = [make_noise([1.2, -0.5], 1500, seed) for seed in range(3)]
    found = fit_autoregression(parts)
    assert found.coefficients == pytest.approx([1.2, -0.5], abs=0.05)


@pytest.mark.parametrize("seed", range(10))
def test_white_noise_has_no_coefficients(seed: int) -> None:
    assert fit_autoregression([make_noise([], 400, seed)]).order == 0


def test_short_or_absent_residuals_count_as_white() -> None:
    assert fit_autoregression([np.ones(3)]).order == 0
    assert fit_autoregression([np.zeros(100)]).order == 0
    assert fit_autoregression([make_noise([0.9], 3, seed) for seed in range(100)]).order == 0


def test_whitening_in_blocks_is_whitening_at_once() -> None:
    noise = Autoregression(np.array([0.7, -0.2]))
    values = np.random.default_rng(1).standard_normal((50, 3))
    blocks = np.concatenate(list(noise.whiten(values, 7)))
    expected = values[2:] - 0.7 * values[1:-1] + 0.2 * values[:-2]
    assert blocks == pytest.approx(expected)
    assert values == pytest.approx(np.random.default_rng(1).standard_normal((50, 3)))
