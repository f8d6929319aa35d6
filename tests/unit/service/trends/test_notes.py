"""Notes beside laws and predictions: what no law can tell, and what no run could have given."""

from math import inf

import pytest

from service.trends.notes import describe_quantity
from service.trends.points import BatchPoint, TrendQuantity
from sysid.trends.trend import TrendEstimate, fit_trend

BOUNDS = (0.0, 1.0)


def describe_trend(
    x: list[float], y: list[float], predict: list[float], bounds: tuple[float, float] = BOUNDS
) -> str:
    errors = [0.001] * len(x)
    points = tuple(
        BatchPoint(at, ("run_1",), "identified", TrendEstimate(value, 0.001), value)
        for at, value in zip(x, y, strict=True)
    )
    one = TrendQuantity("L", "s", "parameter", points, None, bounds)
    return "; ".join(describe_quantity(one, fit_trend(x, y, errors, predict)))


LINE = ([5.0, 10.0, 20.0, 40.0], [0.011, 0.021, 0.041, 0.081])


def test_a_prediction_inside_needs_no_note() -> None:
    assert describe_trend(*LINE, [30.0]) == ""


@pytest.mark.parametrize(
    ("at", "said"),
    [
        (-3.0, "-3 is not above 0, unlike all measured points"),
        (-3.0, "-0.005 s, predicted at -3, is outside the bounds of L (0 to 1 s)"),
        (600.0, "1.201 s, predicted at 600, is outside the bounds of L (0 to 1 s)"),
        (-0.5, "the interval at -0.5 reaches beyond the bounds of L (0 to 1 s)"),
    ],
)
def test_what_physics_does_not_allow_is_noted(at: float, said: str) -> None:
    assert said in describe_trend(*LINE, [at])


def test_an_onset_delay_is_not_below_zero() -> None:
    assert "(0 s or more)" in describe_trend(*LINE, [-3.0], (0.0, inf))


def test_why_there_is_no_power_law_is_noted() -> None:
    told = describe_trend([0.0, *LINE[0]], [0.001, *LINE[1]], [])
    assert "no power law: it needs x > 0, found 0" in told
    assert "power law" not in describe_trend(*LINE, [])


@pytest.mark.parametrize("y", [[0.02, 0.021, 0.02, 0.021], [0.021, 0.02, 0.0205, 0.0205]])
def test_a_law_that_tells_no_dependence_is_noted(y: list[float]) -> None:
    assert "The points show no dependence on x" in describe_trend(LINE[0], y, [])


def test_a_constant_whose_power_law_is_chosen_is_noted_by_its_exponent() -> None:
    told = describe_trend([1.0, 10.0, 100.0, 1000.0], [0.02, 0.0204, 0.0201, 0.0204], [])
    assert "the exponent of the chosen law" in told
