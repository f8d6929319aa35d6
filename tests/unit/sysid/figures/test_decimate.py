"""Thinning a line for a plot."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid.figures.decimate import decimate


@given(st.integers(1, 500), st.integers(2, 60), st.integers(0, 2**32 - 1))
def test_the_extremes_stay_the_order_stays_and_the_number_is_kept(
    samples: int, most: int, seed: int
) -> None:
    values = np.random.default_rng(seed).normal(size=samples)
    times, kept = decimate(np.arange(samples, dtype=float), values, most)
    assert kept.size <= max(most, 2)
    assert np.all(np.diff(times) > 0)
    np.testing.assert_array_equal(values[times.astype(int)], kept)
    assert kept.min() == values.min()
    assert kept.max() == values.max()


def test_a_gap_stays_a_gap() -> None:
    values = np.sin(np.arange(1000.0))
    values[300:600] = np.nan
    times, kept = decimate(np.arange(1000.0), values, 50)
    missing = times[np.isnan(kept)]
    assert missing.size > 0
    assert missing.min() >= 300
    assert missing.max() < 600


def test_fewer_than_two_points_are_no_plot() -> None:
    with pytest.raises(ValueError, match="need 2 or more"):
        decimate(np.zeros(3), np.zeros(3), 1)
