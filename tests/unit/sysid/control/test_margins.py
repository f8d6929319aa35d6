"""Margins of loops that cross a border more than once, or at rest."""

import numpy as np
import pytest

from sysid.control.controllers import PidControl
from sysid.control.linear_form import IdentifiedModel
from sysid.control.margins import compute_margins
from sysid.models.parse import parse_model


def resonant(delay: float) -> IdentifiedModel:
    """A lag and a weakly damped mode beside it: the loop gain passes 1 three times."""
    model = parse_model(
        {
            "name": "m",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "m", "a": "m", "b": "m"},
            "parameters": {"L": {"lower": 0, "upper": 10}},
            "equations": {"x": "u(t - L) - x", "a": "b", "b": "100*(x - a) - 0.2*b"},
            "outputs": {"y": {"expression": "0.9*x + 0.1*a", "unit": "m"}},
        }
    )
    return IdentifiedModel.from_numbers(model, {"L": delay})


def first_order(rate: str) -> IdentifiedModel:
    model = parse_model(
        {
            "name": "m",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "m"},
            "equations": {"x": rate},
            "outputs": {"y": {"expression": "x", "unit": "m"}},
        }
    )
    return IdentifiedModel(model, ())


@pytest.mark.parametrize("delay", [0.02, 0.1, 0.3, 0.5])
def test_a_loop_is_stable_up_to_its_delay_margin_however_often_its_gain_is_one(
    delay: float,
) -> None:
    control = PidControl("u", "y", 2.0)
    found = compute_margins(resonant(delay), control)
    assert found.is_stable
    assert 0.0 < found.phase_margin < 360.0
    assert compute_margins(resonant(delay + 0.98 * found.delay_margin), control).is_stable
    assert not compute_margins(resonant(delay + 1.02 * found.delay_margin), control).is_stable


@pytest.mark.parametrize(
    ("rate", "gain", "factor"), [("x + u", 2.0, 0.5), ("u - x", -0.5, 2.0), ("u - x", -2.0, 0.5)]
)
def test_a_border_at_rest_is_one_of_the_gain(rate: str, gain: float, factor: float) -> None:
    """Of x' = x + K (r - x) the root is 1 - K: it drifts at K = 1, and never swings."""
    found = compute_margins(first_order(rate), PidControl("u", "y", gain))
    assert found.gain_margin == pytest.approx(factor, rel=1e-12)
    assert found.is_stable == (gain > 1 if factor < 1 and gain > 0 else gain > -1)


@pytest.mark.parametrize("gain", [1e-4, -1e-4, 1e-2, -1e-2])
@pytest.mark.parametrize("delay", [0.01, 0.6])
def test_a_sharp_resonance_is_not_missed(gain: float, delay: float) -> None:
    """Of an undamped mode at ω the root moves to the right by K ω sin(ω L)/2: it lags or leads."""
    model = parse_model(
        {
            "name": "m",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"a": "m", "b": "m"},
            "parameters": {"L": {"lower": 0, "upper": 10}},
            "equations": {"a": "b", "b": "100*(u(t - L) - a)"},
            "outputs": {"y": {"expression": "a", "unit": "m"}},
        }
    )
    found = compute_margins(
        IdentifiedModel.from_numbers(model, {"L": delay}), PidControl("u", "y", gain)
    )
    assert found.is_stable == (gain * np.sin(10 * delay) < 0)
    assert found.crossover_frequency == pytest.approx(10.0, rel=abs(gain))


def test_the_phase_at_a_crossing_is_that_of_the_loop_there() -> None:
    """At a sharp resonance the phase turns by degrees from one frequency to the next."""
    found = compute_margins(resonant(0.02), PidControl("u", "y", 2.0))
    s = 1j * found.crossover_frequency
    loop = 2.0 * np.exp(-0.02 * s) / (s + 1) * (0.9 + 10.0 / (s**2 + 0.2 * s + 100))
    assert abs(loop) == pytest.approx(1.0, rel=1e-6)
    assert found.phase_margin == pytest.approx(np.degrees(np.angle(-loop)), rel=1e-6)
