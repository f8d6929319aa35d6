"""Switches whose time is a parameter, against closed forms: outputs, slopes and standard errors."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.optimize import least_squares

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import from_unit, to_unit
from sysid.uncertainty.sensitivities import compute_sensitivities

DOSE = 320.0
TIMES = 0.25 * np.arange(81)


class SwitchCase(NamedTuple):
    """A model with its closed form, and values in the order of its parameters."""

    equation: str
    parameters: dict[str, tuple[float, float]]
    closed: Callable[..., FloatArray]
    values: tuple[float, ...]


def absorb(t: FloatArray, ka: float, volume: float, clearance: float, lag: float) -> FloatArray:
    """First-order absorption of a dose behind a lag: Bateman's function."""
    k, since = clearance / volume, np.maximum(t - lag, 0.0)
    decay = np.exp(-k * since) - np.exp(-ka * since)
    return np.asarray(DOSE * ka / volume / (ka - k) * decay)


def rise(since: FloatArray, gain: float, time: float) -> FloatArray:
    """Answer of a first-order lag to a step."""
    return np.asarray(gain * (1.0 - np.exp(-np.maximum(since, 0.0) / time)))


def infuse(t: FloatArray, gain: float, time: float, start: float, length: float) -> FloatArray:
    """Answer to a pulse: two switches."""
    return rise(t - start, gain, time) - rise(t - start - length, gain, time)


def infuse_often(
    t: FloatArray, gain: float, time: float, start: float, length: float
) -> FloatArray:
    """Answer to pulses with a period of 6 s."""
    pulses = [infuse(t, gain, time, start + 6.0 * n, length) for n in range(-1, 4)]
    # What began before t = 0 begins there.
    early = -rise(t - (start - 6.0), gain, time) + rise(t - (start - 6.0 + length), gain, time)
    inside = max(start - 6.0 + length, 0.0)
    first = rise(t, gain, time) - rise(t - inside, gain, time) if inside else 0.0 * t
    return np.asarray(sum(pulses) + early + first)


def ramp(t: FloatArray, gain: float, time: float, start: float) -> FloatArray:
    """Answer to a ramp that begins somewhere: a bend."""
    since = np.maximum(t - start, 0.0)
    return np.asarray(gain * since - time * rise(since, gain, time))


BOUNDS = {"K": (0.1, 10.0), "T": (0.2, 10.0), "a": (0.0, 18.0), "b": (0.05, 9.0)}
CASES = {
    "absorption": SwitchCase(
        f"where(t > tlag, {DOSE}*ka*exp(-ka*(t - tlag)), 0)/V - CL/V*x",
        {"ka": (0.1, 10), "V": (5, 200), "CL": (0.1, 20), "tlag": (0, 30)},
        absorb,
        (1.1, 32.0, 2.6, 0.9),
    ),
    "pulse": SwitchCase(
        "(K*where(t >= a and not t > a + b, 1, 0) - x)/T", BOUNDS, infuse, (2.0, 1.5, 3.217, 4.96)
    ),
    "pulse within a step": SwitchCase(
        "(K*where(t > a and t < a + b, 1, 0) - x)/T", BOUNDS, infuse, (9.0, 1.5, 3.277, 0.11)
    ),
    "pulses": SwitchCase(
        "(K*where(mod(t - a, 6) < b, 1, 0) - x)/T",
        {**BOUNDS, "a": (0.0, 5.9), "b": (0.05, 5.9)},
        infuse_often,
        (2.0, 1.5, 2.317, 4.2),
    ),
    "signs": SwitchCase(
        "(K/2*(sign(t - a) - sign(t - a - b)) - x)/T", BOUNDS, infuse, (2.0, 1.5, 3.217, 4.96)
    ),
    "ramp": SwitchCase(
        "(K*max(t - a, 0) - x)/T",
        {name: BOUNDS[name] for name in "KTa"},
        ramp,
        (1.2, 2.0, 5.317),
    ),
}


def pose(case: SwitchCase, y: FloatArray | None = None, **solver: Any) -> Problem:
    model = parse_model(
        {
            "name": "switching",
            "form": "differential",
            "states": {"x": "1"},
            "parameters": {n: {"lower": a, "upper": b} for n, (a, b) in case.parameters.items()},
            "equations": {"x": case.equation},
            "outputs": {"y": "x"},
            "initial": {"x": 0},
            "solver": {"substeps": 4, **solver},
        }
    )
    measured = np.zeros(TIMES.size) if y is None else y
    return Problem.build(model, [Record((), (Channel("y", TIMES, measured),))])


@pytest.mark.parametrize("name", CASES)
def test_outputs_are_those_of_the_closed_form(name: str) -> None:
    case = CASES[name]
    found = pose(case).predict(np.array([case.values]))[0]
    expected = case.closed(TIMES, *case.values)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.max(expected))


@pytest.mark.parametrize("lag", [0.0, 0.9, 1.0, 1.0625, 1.03, 19.99, 20.0, 25.0])
def test_a_switch_may_lie_at_a_step_at_a_sample_and_outside_the_record(lag: float) -> None:
    values = (*CASES["absorption"].values[:3], lag)
    found = pose(CASES["absorption"]).predict(np.array([values]))[0]
    np.testing.assert_allclose(found, absorb(TIMES, *values), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", CASES)
def test_sensitivities_are_those_of_the_closed_form(name: str) -> None:
    case = CASES[name]
    problem, theta = pose(case), np.array(case.values)
    found = compute_sensitivities(problem, theta)
    point = to_unit(problem.evaluator, theta[None])[0]
    for d, step in enumerate(1e-6 * np.eye(theta.size)):
        ends = from_unit(problem.evaluator, np.array([point - step, point + step]))
        low, high = (case.closed(TIMES, *end) for end in ends)
        slope = (high - low) / 2e-6
        error = np.linalg.norm(found.columns[:, d] - slope)
        assert error < 1e-3 * np.linalg.norm(slope), case.parameters
    assert not found.one_sided.any()
    assert not found.plateau_width.any()


@pytest.mark.parametrize("method", ["rk4", "euler", "semi-implicit"])
@pytest.mark.parametrize("name", ["absorption", "ramp"])
def test_the_output_has_one_slope_in_the_time_of_a_switch(name: str, method: str) -> None:
    """Differences over a thousandth, and over a hundred thousandth, of an integration step."""
    case = CASES[name]
    problem, theta = pose(case, method=method), np.array(case.values)
    slopes = []
    for step in (6e-5, 6e-7):
        shift = np.zeros(theta.size)
        shift[-1] = step
        low, high = problem.predict(np.array([theta - shift, theta + shift]))
        slopes.append((high - low) / (2.0 * step))
    assert np.linalg.norm(slopes[0]) > 0
    difference = np.linalg.norm(slopes[0] - slopes[1])
    assert difference < 1e-3 * np.linalg.norm(slopes[0])


def test_an_individual_does_not_depend_on_its_neighbours() -> None:
    problem = pose(CASES["pulses"])
    random = np.random.default_rng(3)
    lower, upper = np.array([*CASES["pulses"].parameters.values()]).T
    theta = random.uniform(lower, upper, (37, 4))
    together = problem.predict(theta)
    order = random.permutation(37)
    np.testing.assert_array_equal(problem.predict(theta[order]), together[order])
    np.testing.assert_array_equal(problem.predict(theta[5:6]), together[5:6])


def test_more_switches_than_a_step_can_have_end() -> None:
    case = SwitchCase("floor(1e6*K*t) - x", {"K": (0.1, 10)}, np.zeros_like, (3.3,))
    assert np.all(np.isfinite(pose(case).predict(np.array([[3.3]]))))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["absorption", "pulse", "pulses"])
def test_standard_errors_are_those_of_least_squares_of_the_closed_form(name: str) -> None:
    case = CASES[name]
    exact = case.closed(TIMES, *case.values)
    noise = 0.02 * np.ptp(exact) * np.random.default_rng([32, len(name)]).standard_normal(81)
    problem = pose(case, exact + noise)
    found = identify(problem.model, problem.records[0], seed=1)
    own = least_squares(
        lambda values: case.closed(TIMES, *values) - exact - noise,
        case.values,
        jac="3-point",
        x_scale=case.values,
        xtol=1e-12,
    )
    variance = 2.0 * own.cost / (TIMES.size - own.x.size)
    errors = np.sqrt(variance * np.diag(np.linalg.inv(own.jac.T @ own.jac)))
    assert found.verdict.trust == "trustworthy", found.verdict
    for estimate, value, error in zip(found.parameters, own.x, errors, strict=True):
        assert estimate.status == "identified", estimate
        assert estimate.value == pytest.approx(value, abs=0.05 * error)
        assert estimate.stderr == pytest.approx(error, rel=0.03)


@pytest.mark.slow
def test_a_switch_outside_the_record_is_not_identified_and_spoils_nothing() -> None:
    case = CASES["pulse"]
    values = (2.0, 1.5, 13.217, 8.9)
    exact = infuse(TIMES, *values)
    y = exact + 0.02 * np.random.default_rng(5).standard_normal(TIMES.size)
    problem = pose(case, y)
    found = {e.name: e for e in identify(problem.model, problem.records[0], seed=1).parameters}
    assert found["b"].status in ("ambiguous", "unidentifiable"), found["b"]
    for name, value in zip("KTa", values, strict=False):
        assert found[name].status == "identified"
        assert found[name].stderr is not None
        assert abs(found[name].value - value) < 4.0 * found[name].stderr
