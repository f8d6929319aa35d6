"""Where a loss jumps because the equations switch."""

from typing import Any

import numpy as np
import pytest

from sysid.data.records import Channel, Record
from sysid.judgement.hard_switching import find_hard_switches
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem

TIMES = 0.02 * np.arange(300)
THETA = np.array([1.0, 4.0])
APART = [0.02, 0.3]


def build_problem(friction: str) -> Problem:
    """A mass on a spring with friction, against a record of its own with noise."""
    document: dict[str, Any] = {
        "name": "rubbing",
        "form": "differential",
        "inputs": {"q": "N"},
        "states": {"x": "m", "v": "m/s"},
        "parameters": {"c": {"lower": 0, "upper": 3}, "k": {"lower": 1, "upper": 20}},
        "equations": {"x": "v", "v": f"q - c*({friction}) - k*x"},
        "outputs": {"y": "x"},
    }
    model = parse_model(document)
    force = Channel("q", TIMES, 3.0 * np.sin(5.0 * TIMES), "N")
    blank = Record((force,), (Channel("y", TIMES, np.zeros(TIMES.size), "m"),))
    y = Problem.build(model, [blank]).predict(THETA[None])[0]
    noise = 0.02 * np.random.default_rng(1).normal(size=TIMES.size)
    return Problem.build(model, [Record((force,), (Channel("y", TIMES, y + noise, "m"),))])


@pytest.mark.parametrize(
    ("friction", "smooth"),
    [
        ("sign(v)", "tanh((v)/e)"),
        ("where(v > 0, 1, -1)", "(-1) + ((1) - (-1))*(1 + tanh((v - (0))/e))/2"),
        ("where(v < 0, -1, 1)", "(-1) + ((1) - (-1))*(1 + tanh((v - (0))/e))/2"),
    ],
)
def test_a_switch_is_named_with_its_smooth_form(friction: str, smooth: str) -> None:
    [note] = find_hard_switches(build_problem(friction), THETA, APART)
    assert note.severity == "note"
    assert "RMS 0.02 to 0.3 m" in note.text
    assert smooth in note.text
    replaced = smooth.replace("/e", "/0.01")
    rough, even = (build_problem(one).predict(THETA[None])[0] for one in (friction, replaced))
    np.testing.assert_allclose(rough, even, atol=0.02)
    assert not list(find_hard_switches(build_problem(replaced), THETA, APART))


def test_islands_that_agree_and_losses_without_jumps_are_not_reported() -> None:
    assert not list(find_hard_switches(build_problem("sign(v)"), THETA, [0.02, 0.0201, np.inf]))
    assert not list(find_hard_switches(build_problem("where(v > 0, v, v)"), THETA, APART))
    assert not list(find_hard_switches(build_problem("sign(q)*v"), THETA, APART))
    assert not list(find_hard_switches(build_problem("abs(v)*v"), THETA, APART))
