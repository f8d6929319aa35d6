"""Laws of time: a system that does not know the date answers later what comes later."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Hold
from sysid.models.catalogue.load import load_model
from sysid.simulation.simulate import simulate
from tests.support.profiles import scale_examples

PERIOD, SAMPLES, QUIET = 0.05, 120, 40
SYSTEMS: dict[str, dict[str, float]] = {
    "duffing-delay": {"c": 0.2, "L": 0.52, "b": 5.0, "a": 1.0},
    "duffing-eq16": {"c": 0.2, "L": 0.52, "b": 5.0, "a": 1.0},
    "coulomb-delay": {"c": 0.2, "L": 0.52, "b": 5.0, "mu": 0.1},
    "tube": {"K": 1.0, "T": 0.34, "L": 0.12, "y(0)": 0.0},
    "tube-second-order": {"K": 1.0, "w": 8.0, "z": 0.7, "L": 0.07, "y(0)": 0.0},
    "emps": {"M": 95.0, "Fv": 200.0, "Fc": 2.0, "o": 0.0, "y(0)": 0.0},
    "fopdt": {"K": 2.0, "T": 0.4, "L": 0.22, "y0": 1.0, "x(0)": 0.0},
}


def answer(name: str, values: FloatArray, hold: Hold) -> FloatArray:
    """Output of a system at rest to an input."""
    model = load_model(name)
    times: FloatArray = PERIOD * np.arange(values.size, dtype=np.float64)
    source = Channel(model.inputs[0].name, times, values, hold=hold)
    return simulate(model, [source], SYSTEMS[name], times=times).channels[0].values


def quiet_first(seed: int) -> FloatArray:
    """An input that is nil up to `QUIET` and a random walk after it."""
    walk = np.cumsum(np.random.default_rng(seed).standard_normal(SAMPLES))
    return np.where(np.arange(SAMPLES) < QUIET, 0.0, walk)


@settings(max_examples=scale_examples(12))
@given(
    st.sampled_from(sorted(SYSTEMS)),
    st.sampled_from(["zero", "first"]),
    st.integers(1, 30),
    st.integers(0, 1000),
)
def test_a_delayed_input_delays_the_output(name: str, hold: Any, by: int, seed: int) -> None:
    values = quiet_first(seed)
    late = np.concatenate([np.zeros(by), values[:-by]])
    prompt, delayed = answer(name, values, hold), answer(name, late, hold)
    size = np.max(np.abs(prompt))
    assert size > 0
    np.testing.assert_allclose(delayed[by:], prompt[:-by], rtol=0, atol=1e-7 * size)
    assert np.max(np.abs(delayed[:by] - prompt[0])) <= 1e-7 * size


@pytest.mark.parametrize("name", sorted(SYSTEMS))
@pytest.mark.parametrize("hold", ["zero", "first"])
def test_what_comes_later_changes_nothing_before(name: str, hold: Any) -> None:
    values = quiet_first(3)
    other = np.where(np.arange(SAMPLES) > 80, -5.0, values)
    np.testing.assert_array_equal(answer(name, values, hold)[:80], answer(name, other, hold)[:80])
