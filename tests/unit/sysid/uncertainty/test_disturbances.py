"""Estimated disturbances beside the means and variances of one joint normal distribution."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.uncertainty.disturbances import count_values, estimate_disturbances, measure_sensor
from sysid.uncertainty.output_bands import ParameterSpread

PERIOD, SAMPLES = 0.25, 40
GAIN, CONSTANT, LOAD, CORRELATION = 2.0, 3.0, 1.7, 4.0
TWICE = 1.959963984540054  # deviations of a 95 % band, all degrees of freedom
DOCUMENT: dict[str, Any] = {
    "name": "heated",
    "form": "differential",
    "inputs": {"u": "W"},
    "states": {"x": "K"},
    "parameters": {
        "K": {"lower": 0.1, "upper": 10, "unit": "K/W"},
        "T": {"lower": 1, "upper": 10, "unit": "s"},
    },
    "equations": {"x": "(K*u - x)/T"},
    "outputs": {"y": "x"},
    "initial": {"x": "steady"},
    "solver": {"substeps": 8},
}


def make_record(outputs: tuple[str, ...] = ("y",), missing: tuple[int, ...] = ()) -> Record:
    random, times = np.random.default_rng(3), PERIOD * np.arange(SAMPLES)
    channels = []
    for name in outputs:
        y = np.cumsum(0.3 * random.normal(size=SAMPLES))
        y[list(missing)] = np.nan
        channels.append(Channel(name, times, y))
    return Record((Channel("u", times, np.zeros(SAMPLES), hold="zero"),), tuple(channels))


def spread_by(problem: Problem, covariance: FloatArray | None = None) -> ParameterSpread:
    free = len(problem.free_names)
    return ParameterSpread(
        problem.free_names, np.zeros((free, free)) if covariance is None else covariance, 1e9, 1e9
    )


def condition(
    slopes: FloatArray, noise: FloatArray, rows: FloatArray, deviations: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Condition stationary states (N, n) on samples y (N, m) by one large covariance."""
    n, step = slopes.shape[0], expm(PERIOD * slopes)
    stationary = solve_continuous_lyapunov(slopes, -noise)
    powers = [np.linalg.matrix_power(step, k) for k in range(SAMPLES)]
    joint = np.block(
        [
            [
                powers[i - j] @ stationary if i >= j else stationary @ powers[j - i].T
                for j in range(SAMPLES)
            ]
            for i in range(SAMPLES)
        ]
    )
    seen = np.kron(np.eye(SAMPLES), rows)[np.isfinite(y).ravel()]
    sensor = np.tile(deviations, SAMPLES)[np.isfinite(y).ravel()] ** 2
    gain = joint @ seen.T @ np.linalg.inv(seen @ joint @ seen.T + np.diag(sensor))
    mean = gain @ y.ravel()[np.isfinite(y).ravel()]
    left = np.diag(joint - gain @ seen @ joint)
    return mean.reshape(SAMPLES, n), left.reshape(SAMPLES, n)


@pytest.mark.parametrize("missing", [(), (0, 1, 17, 18, 19, 39)])
def test_a_load_has_the_mean_and_variance_that_all_samples_leave(missing: tuple[int, ...]) -> None:
    record = make_record(missing=missing)
    problem = Problem.build(parse_model(DOCUMENT), [record], loss=Loss(noise_model="load"))
    theta = np.array([GAIN, CONSTANT, LOAD, CORRELATION])
    [[load]] = estimate_disturbances(problem, theta, spread_by(problem))
    mean, variance = condition(
        np.array([[-1 / CONSTANT, GAIN / CONSTANT], [0.0, -1 / CORRELATION]]),
        np.diag([0.0, 2 * LOAD**2 / CORRELATION]),
        np.array([[1.0, 0.0]]),
        np.ones(1),
        record.outputs[0].values[:, None],
    )
    assert (load.place, load.kind, load.unit) == ("u", "load", "W")
    np.testing.assert_array_equal(load.times, record.inputs[0].times)
    np.testing.assert_allclose(load.values, mean[:, 1], atol=1e-5)
    half = TWICE * measure_sensor(problem, theta) * np.sqrt(variance[:, 1])
    np.testing.assert_allclose(load.band[:, 1] - load.values, half, rtol=1e-5)
    np.testing.assert_allclose(load.values - load.band[:, 0], half, rtol=1e-5)
    assert count_values(problem) == (2 * 4 + 1) * SAMPLES * (2 + 4 + 4 + 2 + 1)


def test_states_that_noise_moves_are_estimated_from_all_outputs() -> None:
    document = {**DOCUMENT, "outputs": {"y": "x", "z": "3*x"}}
    record = make_record(("y", "z"), missing=(5, 6))
    weights = {"y": 1.0, "z": 0.5}
    loss = Loss(noise_model="plant")
    problem = Problem.build(parse_model(document), [record], loss=loss, weights=weights)
    size = 0.7
    theta = np.array([GAIN, CONSTANT, size])
    assert problem.free_names == ("K", "T", "noise[x]")
    [[state]] = estimate_disturbances(problem, theta, spread_by(problem))
    mean, variance = condition(
        np.array([[-1 / CONSTANT]]),
        np.array([[size**2]]),
        np.array([[1.0], [3.0]]),
        np.array([1.0, 2.0]),
        np.column_stack([channel.values for channel in record.outputs]),
    )
    assert (state.place, state.kind, state.unit) == ("x", "plant", "K")
    np.testing.assert_allclose(state.values, mean[:, 0], atol=1e-5)
    half = TWICE * measure_sensor(problem, theta) * np.sqrt(variance[:, 0])
    np.testing.assert_allclose(state.band[:, 1] - state.values, half, rtol=1e-5)


@pytest.mark.parametrize("start", ["measured", 0.4])
def test_samples_of_a_recursion_are_estimated_from_those_after_them(start: Any) -> None:
    document = {
        **DOCUMENT,
        "form": "difference",
        "parameters": {"a": {"lower": 0, "upper": 2}, "b": {"lower": -1, "upper": 1}},
        "equations": {"x": "a*x(k-1) + b*x(k-2) + u(k-1)"},
        "initial": {"x": start},
        "solver": {},
        "noise": {"plant": {"x": "estimate"}},
    }
    record, size = make_record(missing=(7, 8)), 0.6
    problem = Problem.build(parse_model(document), [record], loss=Loss(noise_model="plant"))
    theta = np.array([1.5, -0.7, size])
    [[state]] = estimate_disturbances(problem, theta, spread_by(problem))
    # x = F (x(0), x(1), φ(2), …)
    moves = np.eye(SAMPLES)
    for k in range(2, SAMPLES):
        moves[k] += 1.5 * moves[k - 1] - 0.7 * moves[k - 2]
    known = np.isfinite(y := record.outputs[0].values)
    base = moves[:, :2].sum(axis=1) * (0.0 if start == "measured" else start)
    moves = moves if start == "measured" else moves[:, 2:]
    precision = np.r_[[0.0] * (moves.shape[1] - SAMPLES + 2), [size**-2] * (SAMPLES - 2)]
    spread = np.linalg.inv(np.diag(precision) + moves[known].T @ moves[known])
    mean = base + moves @ spread @ moves[known].T @ (y - base)[known]
    left = np.sqrt(np.diag(moves @ spread @ moves.T))
    np.testing.assert_allclose(state.values, mean, atol=1e-5)
    half = TWICE * measure_sensor(problem, theta) * left
    np.testing.assert_allclose(state.band[:, 1] - state.values, half, atol=1e-4)


def test_errors_of_the_parameters_widen_the_band() -> None:
    problem = Problem.build(
        parse_model(
            {
                **DOCUMENT,
                "outputs": {"y": "x + c"},
                "parameters": {**DOCUMENT["parameters"], "c": {"lower": -9, "upper": 9}},
            }
        ),
        [make_record()],
        loss=Loss(noise_model="load"),
    )
    theta = np.array([GAIN, CONSTANT, 0.0, LOAD, CORRELATION])
    assert problem.free_names[2] == "c"
    covariance = np.zeros((5, 5))
    covariance[2, 2] = 0.2**2
    [[known]] = estimate_disturbances(problem, theta, spread_by(problem))
    [[uncertain]] = estimate_disturbances(problem, theta, spread_by(problem, covariance))
    moved = theta + np.array([0.0, 0.0, 0.2, 0.0, 0.0])
    [[shifted]] = estimate_disturbances(problem, moved, spread_by(problem))
    np.testing.assert_allclose(uncertain.values, known.values)
    halves = [one.band[:, 1] - one.values for one in (known, uncertain)]
    expected = np.hypot(halves[0], TWICE * (shifted.values - known.values))
    np.testing.assert_allclose(halves[1], expected, rtol=1e-6)


def test_a_free_run_has_no_disturbances() -> None:
    problem = Problem.build(parse_model(DOCUMENT), [make_record()])
    assert estimate_disturbances(problem, np.array([GAIN, CONSTANT]), spread_by(problem)) == ()
