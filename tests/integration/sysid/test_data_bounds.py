"""Generic models find a plant in its own units, with nothing given."""

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model


def respond(u: FloatArray, lag: int, taus: tuple[float, ...], gain: float) -> FloatArray:
    """First-order parts after a dead time, in samples, from rest; the input is held."""
    late = np.concatenate([np.full(lag, u[0]), u])[: u.size]
    y = gain * np.repeat(late, 20)
    for tau in taus:
        decay, x, level = np.exp(-1 / 20 / tau), np.empty(y.size), y[0]
        for k, target in enumerate(y):
            x[k] = level
            level = decay * level + (1 - decay) * target
        y = x
    return y[::20]


@pytest.mark.parametrize("seed", range(3))
def test_a_warm_plant_is_found_without_an_option(seed: int) -> None:
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0, 60, 12), 50)
    y = 20 + respond(u, 12, (40.0, 15.0), 0.8) + rng.normal(0, 0.15, u.size)
    times = np.arange(float(u.size))
    record = Record((Channel("u", times, u, "%"),), (Channel("y", times, y, "degC"),))
    found = identify(load_model("sopdt"), record, seed=seed)
    estimates = {estimate.name: estimate for estimate in found.parameters}
    truth = {"K": 0.8, "T1": 40.0, "r": 15 / 40, "L": 12.0, "y0": 20.0}
    for name, value in truth.items():
        stderr = estimates[name].stderr
        assert stderr is not None
        assert abs(estimates[name].value - value) < 4 * stderr
    assert found.initial == "rest"
    assert found.data_bounds == ("K", "T1", "L", "y0")


@pytest.mark.parametrize(("gain", "offset"), [(2e5, 1e5), (-1e-3, 0.0)])
def test_units_do_not_matter(gain: float, offset: float) -> None:
    u = np.where(np.arange(300) % 100 >= 40, 1.0, 0.0)
    noise = 1e-3 * gain * np.random.default_rng(0).standard_normal(u.size)
    times = 0.01 * np.arange(u.size)
    y = offset + respond(u, 12, (30.0,), gain) + noise
    record = Record((Channel("u", times, u),), (Channel("y", times, y),))
    values = {e.name: e.value for e in identify(load_model("fopdt"), record).parameters}
    assert values["K"] == pytest.approx(gain, rel=0.01)
    assert values["T"] == pytest.approx(0.3, rel=0.02)
    assert values["L"] == pytest.approx(0.12, abs=2e-3)
