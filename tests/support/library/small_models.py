"""Small models and records that several tests of the numerical core share."""

from typing import Any

import numpy as np

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Hold, Record
from sysid.models.model import Model
from sysid.models.parse import parse_model

PARAMETERS = {
    "c": {"lower": 0, "upper": 1},
    "L": {"lower": 0, "upper": 0.4},
    "b": {"lower": 0, "upper": 10},
}

LINE: dict[str, Any] = {
    "name": "line",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {"a": {"lower": 0.1, "upper": 10}, "b": {"lower": -5, "upper": 5}},
    "equations": {"x": "-x"},
    "outputs": {"y": "a*u(t) + b + x"},
    "initial": {"x": 0},
}
"""A straight line in the input: what is known of linear regression holds for it."""

ARX: dict[str, Any] = {
    "name": "arx",
    "form": "polynomial",
    "output": "y",
    "inputs": {"u": "V"},
    "degree": 1,
    "lags": {"y": [1], "u": [1]},
    "coefficients": {"lower": -2, "upper": 2},
    "initial": {"y": 0},
}
"""The polynomial of first degree in one past output and one past input."""


def difference(equations: dict[str, str], output: str, **fields: Any) -> Model:
    """A recursion with input u and the parameters c, L, b."""
    return _model("difference", equations, output, fields)


def differential(equations: dict[str, str], output: str, **fields: Any) -> Model:
    """A differential model with input u and the parameters c, L, b."""
    return _model("differential", equations, output, fields)


def _model(form: str, equations: dict[str, str], output: str, fields: dict[str, Any]) -> Model:
    document: dict[str, Any] = {
        "name": "test",
        "form": form,
        "inputs": {"u": "V"},
        "states": dict.fromkeys(equations, "m"),
        "parameters": PARAMETERS,
        "equations": equations,
        "outputs": {"y": output},
        "initial": dict.fromkeys(equations, 0.3),
    }
    return parse_model(document | fields)


def duffing() -> Model:
    """The recursion of Eq. 16."""
    force = "c*(x(k-1 - L/h) - x(k-2 - L/h))/h + b*x(k-2) + a*x(k-2)**3 - u(k-2)"
    return difference(
        {"x": f"2*x(k-1) - x(k-2) - h**2*({force})"},
        "x",
        parameters=PARAMETERS | {"a": {"lower": 0, "upper": 5}},
        initial={"x": 0},
    )


def lag_element(**fields: Any) -> Model:
    """First-order lag behind a dead time: b·dx/dt + x = c·u(t - L)."""
    bounds = PARAMETERS | {"b": {"lower": 0.05, "upper": 2}, "c": {"lower": -2, "upper": 2}}
    defaults = {"parameters": bounds, "initial": {"x": 0}}
    return differential({"x": "(c*u(t - L) - x)/b"}, "x", **(defaults | fields))


def record(
    samples: int = 30,
    period: float = 0.05,
    *,
    irregular: bool = False,
    hold: Hold = "first",
    seed: int = 1,
    outputs: tuple[str, ...] = ("y",),
) -> Record:
    """A random-walk input and smooth outputs."""
    rng = np.random.default_rng(seed)
    times = period * np.arange(samples)
    own = np.sort(rng.random(samples)) * times[-1] if irregular else times
    u = 0.3 * np.cumsum(rng.standard_normal(samples))
    measured = tuple(Channel(name, own, np.sin(own) + i) for i, name in enumerate(outputs))
    return Record((Channel("u", times, u, hold=hold),), measured)


def with_output(record_: Record, values: FloatArray, name: str = "y") -> Record:
    """The record with other measured values."""
    times = record_.outputs[0].times
    return Record(record_.inputs, (Channel(name, times, values),))


def individuals(problem: Any, count: int, seed: int = 0) -> FloatArray:
    """Random candidates inside the bounds, the first two at their ends."""
    lower = np.array([p.lower for p in problem.free_parameters])
    upper = np.array([p.upper for p in problem.free_parameters])
    drawn = np.random.default_rng(seed).random((count, lower.size))
    drawn[:2] = [[0.0], [1.0]][: min(count, 2)]
    return np.asarray(lower + (upper - lower) * drawn)
