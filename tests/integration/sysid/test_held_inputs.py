"""A held input with an unknown lag: the response of the plant itself, and honest intervals."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from sysid import Channel, Record, identify, load_model, simulate
from sysid.core.types import FloatArray
from sysid.data.interpolation import interpolate_input
from sysid.models.catalogue.load import copy_catalogue_document
from tests.support.profiles import draw_seeds
from tests.support.random_bounds import bound_count

T, K = 4.0, 2.0  # s, 1; sampled once a second


def make_steps(seed: int, samples: int = 300) -> FloatArray:
    """An input that is held for ten samples at a time."""
    levels = np.random.default_rng(seed).choice([0.0, 1.0], samples // 10)
    return np.asarray(np.repeat(levels, 10))


def exact(u: FloatArray, lag: float) -> FloatArray:
    """First order with dead time and a held input, by the exponential of each piece."""
    y, x = np.empty(u.size), K * u[0]
    whole = int(np.floor(lag))
    late = lag - whole  # s into a sample at which the delayed input changes
    y[0] = x
    for k in range(1, u.size):
        for level, time in ((u[max(k - 2 - whole, 0)], late), (u[max(k - 1 - whole, 0)], 1 - late)):
            x = K * level + (x - K * level) * np.exp(-time / T)
        y[k] = x
    return y


def make_record(u: FloatArray, y: FloatArray) -> Record:
    times = np.arange(float(u.size))
    return Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))


@pytest.mark.parametrize("lag", [0.0, 0.1, 1.0, 2.37, 3.5, 4.999])
@pytest.mark.parametrize("substeps", [2, 8])
def test_the_response_is_that_of_the_plant(lag: float, substeps: int) -> None:
    u = make_steps(3)
    model = load_model(
        {**copy_catalogue_document("tube"), "solver": {"method": "rk4", "substeps": substeps}}
    )
    found = simulate(
        model,
        [Channel("u", np.arange(300.0), u, hold="zero")],
        {"K": K, "T": T, "L": lag, "y(0)": K * u[0]},
        times=np.arange(300.0),
    )
    np.testing.assert_allclose(found.channel("y").values, exact(u, lag), atol=0.05 / substeps * K)


def test_the_response_moves_with_the_lag_without_stairs() -> None:
    u, model = make_steps(3), load_model("tube")
    inputs = [Channel("u", np.arange(300.0), u, hold="zero")]
    lags = np.linspace(2.0, 3.0, 41)
    curves = [
        simulate(model, inputs, {"K": K, "T": T, "L": lag, "y(0)": 0.0}, times=np.arange(300.0))
        .channel("y")
        .values
        for lag in lags
    ]
    moves = [float(np.max(np.abs(b - a))) for a, b in pairwise(curves)]
    assert min(moves) > 0.3 * max(moves)  # a staircase has moves of 0


@pytest.mark.slow
def test_intervals_of_a_lag_cover_it() -> None:
    missed, seeds = [], draw_seeds(gate=12, night=300)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        lag, u = rng.uniform(0.2, 4.8), make_steps(seed)
        data = make_record(u, exact(u, lag) + rng.normal(0, 0.01, u.size))
        bounds: dict[str, Any] = {"T": {"upper": 20.0}, "L": {"upper": 10.0}}
        found = identify(load_model("fopdt"), [data], parameters=bounds, seed=seed)
        (estimate,) = (one for one in found.parameters if one.name == "L")
        assert estimate.interval95 is not None
        if not estimate.interval95[0] <= lag <= estimate.interval95[1]:
            missed.append((lag, estimate.value, estimate.stderr))
    # Four of 25 were covered before.
    assert len(missed) <= bound_count(len(seeds), 0.06)[1], missed


def test_the_mean_of_a_held_input_is_exact_and_a_constant_stays_what_it_is() -> None:
    times = np.array([0.0, 1.0, 2.0, 3.0])
    channel = Channel("u", times, np.array([0.3, 0.3, 1.3, 0.3]), hold="zero")
    fine = interpolate_input(channel, 0.0, 1.0, 3, 2.0, "around")
    at = {0.0: 0.3, 1.0: 0.3, 1.5: 0.3, 1.75: 0.55, 2.0: 0.8, 2.5: 1.3, 3.0: 0.8, 3.5: 0.3}
    for time, value in at.items():
        place = fine.start_index + round(time * fine.points_per_step)
        assert fine.values[place] == pytest.approx(value, abs=1e-12)
    flat = Channel("u", times, np.full(4, 0.1), hold="zero")
    assert np.all(interpolate_input(flat, 0.0, 1.0, 3, 2.0, "around").values == 0.1)
