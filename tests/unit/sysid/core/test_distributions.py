"""Tails of distributions: tables of textbooks, and the values that have a given tail."""

from collections.abc import Callable
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sysid.core.distributions import (
    chi_square_limit,
    chi_square_tail,
    f_tail,
    student_limit,
    student_tail,
)


@pytest.mark.parametrize(
    ("tail", "probability"),
    [
        (lambda: chi_square_tail(10, 18.307), 0.05),
        (lambda: f_tail(2, 20, 3.4928), 0.05),
        (lambda: student_tail(10, 2.2281), 0.025),
        (lambda: student_tail(10, -2.2281), 0.975),
        (lambda: student_tail(inf, 1.9600), 0.025),
    ],
)
def test_tails_are_those_of_the_tables(tail: Callable[[], float], probability: float) -> None:
    assert tail() == pytest.approx(probability, rel=1e-3)


@given(st.integers(1, 40) | st.floats(1.0, 1e4), st.floats(1e-6, 0.49))
def test_a_limit_is_exceeded_with_its_probability(degrees: float, probability: float) -> None:
    for limit, tail in ((chi_square_limit, chi_square_tail), (student_limit, student_tail)):
        assert tail(degrees, limit(degrees, probability)) == pytest.approx(probability, rel=1e-6)
