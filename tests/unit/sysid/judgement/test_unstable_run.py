"""A free run that disturbances mislead, and the predictions that they do not."""

import re
from typing import Any

import numpy as np
import pytest

from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.judgement.unstable_run import (
    OneStepComparison,
    compute_growth,
    find_misled_run,
)
from sysid.models.parse import parse_model
from sysid.results.identification import Identification
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import Estimate

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


def list_told(found: Identification) -> list[str]:
    return [text for text in found.warnings if "Use loss=Loss(noise_model='load')" in text]


@pytest.mark.parametrize("seed", [1, 3])
def test_the_estimates_of_a_filter_are_told_of_an_unstable_plant(seed: int) -> None:
    record = run_loop(seed, 0.03)
    found = identify(PLANT, record)
    (told,) = list_told(found)
    assert "the free run is unstable" in told
    ahead = identify(PLANT, record, loss=Loss(noise_model="load"))
    for name, true in TRUTH.items():
        one = ahead[name]
        assert one.interval95 is not None
        assert one.interval95[0] <= true <= one.interval95[1]
        [printed] = re.findall(rf"\b{name} = ([\d.]+)", told)
        assert float(printed) == pytest.approx(one.value, rel=0.01)
    assert found["a"].status == "dependent"
    assert "disturbances mislead the free run" in found["a"].reason
    assert f"it is {ahead['a'].value:.2f}" in found["a"].reason
    assert found.verdict.trust == "not trustworthy"
    assert "disturbances mislead the free run" in found.verdict.text


@pytest.mark.parametrize("seed", [1, 3])
def test_a_right_prediction_one_step_ahead_is_trustworthy(seed: int) -> None:
    ahead = identify(PLANT, run_loop(seed, 0.03), prediction="one-step")
    assert ahead.verdict.text == "trustworthy"


def make_estimate(value: float, stderr: float) -> Estimate:
    interval = (value - 2 * stderr, value + 2 * stderr)
    return Estimate("a", "1/s", value, -1.0, 1.0, stderr, interval, "identified")


@pytest.mark.parametrize(
    ("free", "ahead", "is_outside"),
    [
        (make_estimate(0.17, 1e-4), make_estimate(0.20, 0.01), True),
        (make_estimate(0.19, 1e-4), make_estimate(0.20, 0.01), True),
        (make_estimate(0.17, 0.02), make_estimate(0.20, 0.01), False),
    ],
)
def test_only_a_value_outside_the_interval_of_the_free_run_contradicts_it(
    free: Estimate, ahead: Estimate, is_outside: bool
) -> None:
    comparison = OneStepComparison("the free run is unstable", (ahead,), ("prediction: one-step",))
    [found] = find_misled_run((free,), comparison)
    assert found.parameters == (("a",) if is_outside else ())
    assert found.severity == ("serious" if is_outside else "note")
    assert found.advice == "Use prediction: one-step."
    [move] = found.moves
    assert (move.parameter, move.value, move.stderr) == ("a", ahead.value, ahead.stderr)
    assert move.stderrs == pytest.approx((ahead.value - free.value) / (free.stderr or 0.0))
    assert list(find_misled_run((free,), None)) == []


def test_a_stable_plant_with_white_residuals_needs_no_other_prediction() -> None:
    random = np.random.default_rng(3)
    u, x = np.repeat(random.normal(size=N // 10), 10), np.zeros(N)
    for k in range(1, N):
        x[k] = x[k - 1] + STEP * (-0.5 * x[k - 1] + u[k - 1])
    assert not list_told(identify(PLANT, make_record(u, x + 0.02 * random.standard_normal(N))))


@pytest.mark.parametrize(("a", "least", "most"), [(-0.3, 0, 1), (0.0, 1, 1.01), (0.25, 1e3, 1e8)])
def test_the_effect_of_a_start_grows_as_the_poles_say(a: float, least: float, most: float) -> None:
    problem = Problem.build(parse_model(PLANT), [run_loop(1, 0.0)])
    assert least <= compute_growth(problem, np.array([a, 1.0])) <= most
