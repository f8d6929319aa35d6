"""Our two functions of statistics are those of SciPy."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import gammaincc, stdtrit

from sysid.distributions import chi_squared_tail, median, student_95


@given(degrees=st.floats(0.5, 3000), share=st.floats(1e-4, 3))
def test_the_tail_of_chi_squared_is_the_upper_incomplete_gamma_function(
    degrees: float, share: float
) -> None:
    expected = float(gammaincc(degrees / 2, degrees * share / 2))
    assert chi_squared_tail(degrees, degrees * share) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("degrees", [1, 2.0, 25])
def test_the_tail_of_chi_squared_at_its_ends(degrees: float) -> None:
    assert chi_squared_tail(degrees, 0.0) == 1.0
    assert chi_squared_tail(degrees, math.inf) == 0.0
    assert math.isnan(chi_squared_tail(degrees, math.nan))


@given(degrees=st.floats(0.7, 1e7))
def test_the_interval_of_student_is_the_quantile(degrees: float) -> None:
    assert student_95(degrees) == pytest.approx(float(stdtrit(degrees, 0.975)), rel=1e-11)


def test_the_interval_of_student_narrows_as_the_degrees_grow() -> None:
    widths = [student_95(float(degrees)) for degrees in np.geomspace(1, 1e6, 300)]
    assert all(before > after for before, after in pairwise(widths))


@given(st.lists(st.floats(allow_infinity=False), min_size=1, max_size=9))
def test_the_median_is_that_of_numpy(values: list[float]) -> None:
    with np.errstate(all="ignore"):
        assert np.array_equal(median(np.array(values)), np.median(values), equal_nan=True)
