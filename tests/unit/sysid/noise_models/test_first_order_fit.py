"""A minimum in an interval, as SciPy finds it."""

from collections.abc import Callable
from math import cosh, exp, log

import pytest
from scipy.optimize import minimize_scalar

from sysid.noise_models.first_order_fit import find_minimum


def compute_skewed(x: float) -> float:
    return 300.0 * log(1.0 + exp(x) + exp(-0.5 * x))


def compute_even(x: float) -> float:
    return cosh(x - 0.3)


@pytest.mark.parametrize("function", [compute_skewed, compute_even])
def test_a_minimum_is_that_of_scipy(function: Callable[[float], float]) -> None:
    best = minimize_scalar(function, bounds=(-5.0, 4.0), method="bounded").x
    assert abs(find_minimum(function, -5.0, 4.0) - best) < 1e-3


@pytest.mark.parametrize(("slope", "end"), [(1.0, -5.0), (-1.0, 4.0)])
def test_a_minimum_at_an_end_is_found(slope: float, end: float) -> None:
    assert abs(find_minimum(lambda x: slope * x, -5.0, 4.0) - end) < 0.05


@pytest.mark.parametrize("value", [1.0, float("inf"), float("nan")])
def test_where_all_is_alike_any_point_is_found(value: float) -> None:
    assert -5.0 <= find_minimum(lambda _: value, -5.0, 4.0) <= 4.0
