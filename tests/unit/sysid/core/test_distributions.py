"""Tails of distributions against SciPy's, and the values that have a given tail."""

from math import inf, isnan, nan

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special

from sysid.core.distributions import (
    chi_square_limit,
    chi_square_tail,
    f_tail,
    student_limit,
    student_tail,
)

DEGREES = st.integers(1, 40) | st.floats(1.0, 1e5)
PROBABILITIES = st.floats(1e-6, 0.49)
TAILS = (chi_square_tail, student_tail)


def near(value: float) -> object:
    """Compare all digits that SciPy's own value has; what is below 1e-200 decides nothing."""
    return pytest.approx(value, rel=1e-11, abs=1e-200)


@given(DEGREES, st.floats(1e-3, 30.0))
def test_the_tail_of_chi_square_is_that_of_scipy(degrees: float, ratio: float) -> None:
    value = degrees * ratio
    assert chi_square_tail(degrees, value) == near(special.chdtrc(degrees, value))


@given(st.integers(1, 60), DEGREES, st.floats(1e-3, 1e3))
def test_the_tail_of_f_is_that_of_scipy(numerator: int, denominator: float, value: float) -> None:
    assert f_tail(numerator, denominator, value) == near(
        special.fdtrc(numerator, denominator, value)
    )


@given(DEGREES, st.floats(-100.0, 100.0))
def test_the_tail_of_student_is_that_of_scipy(degrees: float, value: float) -> None:
    assert student_tail(degrees, value) == near(special.stdtr(degrees, -value))


@given(DEGREES, PROBABILITIES)
def test_a_limit_is_exceeded_with_its_probability(degrees: float, probability: float) -> None:
    for limit, tail in ((chi_square_limit, chi_square_tail), (student_limit, student_tail)):
        assert tail(degrees, limit(degrees, probability)) == near(probability)


def test_a_limit_of_student_tends_to_the_normal_one() -> None:
    assert student_limit(inf, 0.025) == near(1.959963984540054)
    assert student_limit(1e9, 0.025) == pytest.approx(student_limit(inf, 0.025), rel=1e-8)


def test_ends_of_the_tails() -> None:
    for tail in TAILS:
        assert tail(3.0, inf) == 0.0
        assert tail(3.0, -inf) == 1.0
    assert f_tail(1.0, 3.0, 0.0) == 1.0
    assert f_tail(1.0, 3.0, inf) == 0.0


@pytest.mark.parametrize("degrees", [0.0, -1.0, nan])
def test_without_degrees_of_freedom_nothing_is_told(degrees: float) -> None:
    for tail in TAILS:
        assert isnan(tail(degrees, 1.0))
    assert isnan(student_limit(degrees, 0.025))
    assert isnan(f_tail(1.0, degrees, 1.0))


def test_of_no_number_there_is_no_tail() -> None:
    for tail in TAILS:
        assert isnan(tail(3.0, nan))
