"""Polynomial models and records of theirs that tests share."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sysid.data.records import Channel, Hold, Record
from sysid.models.parse import parse_model
from sysid.simulation.simulate import simulate

PERIOD = 0.1
TRUTH = {"y(k-1)": 0.6, "y(k-2)": -0.3, "u(k-1)": 0.8, "y(k-1)*u(k-2)": 0.3, "u(k-1)**2": -0.2}
"""Terms and coefficients of a stable polynomial."""

LAGGED = {
    "y(k-1)": 0.5,
    "y(k-1-dh)": -0.2,
    "u(k-1)": 0.6,
    "u(k-1-dk)": 0.5,
    "y(k-1)*u(k-1-dk)": 0.2,
}
"""The same with two unknown lags."""


def document(terms: object, **changes: Any) -> dict[str, Any]:
    """A polynomial of second degree in y(k-1), y(k-2), u(k-1), u(k-2)."""
    return {
        "name": "polynomial",
        "form": "polynomial",
        "output": "y",
        "inputs": {"u": "V"},
        "degree": 2,
        "lags": {"y": [1, 2], "u": [1, 2]},
        "coefficients": {"lower": -2, "upper": 2},
        "terms": terms,
        **changes,
    }


def build_lagged(terms: object, **changes: Any) -> dict[str, Any]:
    """A polynomial with an unknown lag of the output and one of the input."""
    fields = {
        "lags": {"y": [1, "1 + dh"], "u": [1, "1 + dk"]},
        "parameters": {"dh": {"lower": 0, "upper": 6}, "dk": {"lower": 0, "upper": 9}},
    }
    return document(terms, **(fields | changes))


def frols(keep: int, **fields: Any) -> dict[str, Any]:
    """A rule."""
    return {"select": "frols", "keep": keep, **fields}


def record_of(
    truth: Mapping[str, float],
    *,
    samples: int = 400,
    seed: int = 1,
    noise: float = 0.0,
    lags: Mapping[str, float] | None = None,
    hold: Hold = "first",
) -> Record:
    """The free run of a polynomial with these coefficients, from a random input."""
    written = [term for term in truth if term != "1"]
    model = parse_model((build_lagged if lags else document)(written, constant="1" in truth))
    rng = np.random.default_rng(seed)
    times = PERIOD * np.arange(samples)
    source = Channel("u", times, rng.uniform(-1.0, 1.0, samples), "V", hold)
    values = {f"a[{term}]": value for term, value in truth.items()} | dict(lags or {})
    clean = simulate(model, [source], {**values, "y(0)": 0.0}, times=times).channel("y")
    noisy = clean.values + noise * rng.standard_normal(samples)
    return Record((source,), (Channel("y", times, noisy),))
