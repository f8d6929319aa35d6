"""A difference model means the same compiled as read plainly, sample by sample."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.data.records import Channel
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.simulation.simulate import simulate as simulate_compiled
from tests.support.library.expression_values import simulate as simulate_plainly

H, N = 0.02, 150
FORCE = 10.0 * np.cos(5.0 * H * np.arange(N)) + 0.3


def simulate_both_ways(
    model: Model, values: dict[str, float]
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Each output as compiled and as read plainly."""
    times = H * np.arange(N)
    inputs = {signal.name: FORCE for signal in model.inputs}
    channels = [Channel(name, times, force) for name, force in inputs.items()]
    found = simulate_compiled(model, channels, values, times=times)
    plain = simulate_plainly(model, values, inputs, H, N)
    for output in model.outputs:
        state = getattr(output.expression, "name", "")
        yield found.channel(output.name).values, plain[state]


def are_the_same(found: FloatArray, expected: FloatArray) -> bool:
    return np.ptp(expected) > 0 and np.allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("duffing-eq16", {"c": 0.2, "L": 0.5, "b": 5.0, "a": 1.0}),
        ("duffing-eq16", {"c": 0.9, "L": 0.0137, "b": 1.0, "a": 0.1}),
        ("coulomb-eq16", {"c": 0.2, "L": 0.333, "b": 5.0, "mu": 0.5}),
        ("coulomb-delay", {"c": 0.2, "L": 0.333, "b": 5.0, "mu": 0.5}),
        ("exponential", {"L": 0.8}),
    ],
)
def test_a_recursion_of_the_catalogue_is_computed_as_written(
    name: str, values: dict[str, float]
) -> None:
    assert all(are_the_same(*pair) for pair in simulate_both_ways(load_model(name), values))


@pytest.mark.parametrize(
    "equations",
    [
        {"x": "0.5*x(k-1) + 0.1*q", "w": "x"},
        {"x": "0.5*x(k-d) + 0.1*q(k-1)", "w": "x(k-1-d)"},
        {"x": "0.5*w + 0.1*q(k - L/h)", "w": "0.9*x(k-1.25)"},
        {"x": "0.3*w(k - L/h) + 0.2*w", "w": "0.5*x(k-2 - L/h) + 0.1*q(k-3)"},
        {"x": "where(q > 0 and not w < -1, 0.1*q, w)", "w": "sin(x(k-1)) - 0.2*h*k"},
        {"x": "max(min(q, 2, w + 1), -d)", "w": "tanh(x(k - (L + h)/h)) + abs(q)**1.5"},
        {"x": "0.9*x(k - 6 + d) + 0.01*q", "w": "exp(-t)*sqrt(d) - atan(x) + 2**-x"},
    ],
)
@pytest.mark.parametrize("lag", [0.0, 0.03, 0.0512])
def test_every_kind_of_past_value_and_function_is_computed_as_written(
    equations: dict[str, str], lag: float
) -> None:
    document: dict[str, Any] = {
        "name": "written",
        "form": "difference",
        "inputs": {"q": "N"},
        "states": {"x": "1", "w": "1"},
        "parameters": {
            "L": {"lower": 0, "upper": 0.1, "unit": "s"},
            "d": {"lower": 1, "upper": 5, "unit": "samples"},
        },
        "equations": equations,
        "outputs": {"y": "x", "z": "w"},
        "initial": {"x": 0.25, "w": 0.5},
    }
    pairs = list(simulate_both_ways(parse_model(document), {"L": lag, "d": 1.0 + 20 * lag}))
    assert [are_the_same(*pair) for pair in pairs] == [True, True]
