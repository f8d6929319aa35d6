"""A free run that disturbances mislead, and the predictions that they do not."""

from typing import Any

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.identification.unstable_run import compute_growth
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem

STEP, N = 0.2, 300
PLANT: dict[str, Any] = {
    "name": "unstable",
    "form": "difference",
    "inputs": {"u": "V"},
    "states": {"x": "V"},
    "parameters": {
        "a": {"lower": -1, "upper": 1, "unit": "1/s"},
        "b": {"lower": 0, "upper": 5, "unit": "1/s"},
    },
    "equations": {"x": "x(k-1) + h*(a*x(k-1) + b*u(k-1))"},
    "outputs": {"y": "x"},
    "initial": {"x": "measured"},
}
TRUTH = {"a": 0.25, "b": 1.0}


def run_loop(seed: int, shock: float) -> Record:
    """The plant in a proportional loop, with random disturbances inside it."""
    random = np.random.default_rng(seed)
    reference = np.repeat(random.choice([-1.0, 1.0], N // 20), 20)
    x, u = np.zeros(N), np.zeros(N)
    for k in range(N):
        u[k] = -0.8 * (x[k] + 0.002 * random.standard_normal() - reference[k])
        if k + 1 < N:
            flow = TRUTH["a"] * x[k] + TRUTH["b"] * u[k]
            x[k + 1] = x[k] + STEP * flow + shock * random.standard_normal()
    return make_record(u, x)


def make_record(u: FloatArray, y: FloatArray) -> Record:
    times = STEP * np.arange(N)
    return Record((Channel("u", times, u, "V", "zero"),), (Channel("y", times, y, "V"),))


def list_told(record: Record) -> list[str]:
    found = identify(PLANT, record)
    return [text for text in found.warnings if "Use prediction: one-step" in text]


@pytest.mark.parametrize("seed", [1, 2])
def test_one_step_ahead_estimates_of_an_unstable_plant_are_told(seed: int) -> None:
    record = run_loop(seed, 0.03)
    (told,) = list_told(record)
    assert "the free run is unstable" in told
    ahead = identify(PLANT, record, prediction="one-step")
    for one in ahead.estimates:
        assert one.interval95 is not None
        assert one.interval95[0] <= TRUTH[one.name] <= one.interval95[1]
        assert f"{one.name} = {one.value:.4g} ± {one.stderr:.2g} 1/s" in told


def test_a_stable_plant_with_white_residuals_needs_no_other_prediction() -> None:
    random = np.random.default_rng(3)
    u, x = np.repeat(random.normal(size=N // 10), 10), np.zeros(N)
    for k in range(1, N):
        x[k] = x[k - 1] + STEP * (-0.5 * x[k - 1] + u[k - 1])
    assert not list_told(make_record(u, x + 0.02 * random.standard_normal(N)))


@pytest.mark.parametrize(("a", "least", "most"), [(-0.3, 0, 1), (0.0, 1, 1.01), (0.25, 1e3, 1e8)])
def test_the_effect_of_a_start_grows_as_the_poles_say(a: float, least: float, most: float) -> None:
    problem = Problem.build(parse_model(PLANT), [run_loop(1, 0.0)])
    assert least <= compute_growth(problem, np.array([a, 1.0])) <= most
