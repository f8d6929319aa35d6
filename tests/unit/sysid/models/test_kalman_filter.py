"""The filter of a model beside a Kalman filter of discrete matrices, written for it alone."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov

from sysid.core.errors import InvalidModel, InvalidSettings
from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.kalman_filter import list_plant_noise
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from tests.support.library.walking_records import PERIOD, SAMPLES, make_walk

LAG = 19 / 32  # it ends with an integration step
GAIN, CONSTANT, LOAD, CORRELATION = 2.0, 3.0, 1.7, 4.0


class Filtered(NamedTuple):
    """Innovations and their variances, both in the order of the samples."""

    innovations: FloatArray
    variances: FloatArray

    @property
    def fitness(self) -> float:
        """exp(-2/n log likelihood), of the most likely variance of the sensor, and its root."""
        mean = np.mean(self.innovations**2 / self.variances)
        return float(np.sqrt(mean) * np.exp(0.5 * np.mean(np.log(self.variances))))


def filter_outputs(
    steps: Sequence[tuple[FloatArray, FloatArray, FloatArray]],
    rows: FloatArray,
    weights: FloatArray,
    start: FloatArray,
    spread: FloatArray,
    y: FloatArray,
) -> Filtered:
    """Filter y (N, outputs) by x' = A x + b + noise of covariance Q; nan: not measured."""
    x, p, found = start.copy(), spread.copy(), []
    for (a, b, q), values in zip(steps, y, strict=True):
        for row, weight, value in zip(rows, weights, values, strict=True):
            if np.isnan(value):
                continue
            variance = row @ p @ row + weight**-2
            gain = p @ row / variance
            error = value - row @ x
            found.append((weight * error, weight**2 * variance))
            x = x + gain * error
            p = p - np.outer(gain, row @ p)
        x, p = a @ x + b, a @ p @ a.T + q
    return Filtered(*np.array(found).T)


def discretise(
    a: FloatArray, b: FloatArray, q: FloatArray, inputs: Sequence[tuple[float, FloatArray]]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Discretise x' = a x + b u + noise q over pieces of time with constant inputs."""
    n = a.shape[0]
    phi, drive, covariance = np.eye(n), np.zeros(n), np.zeros((n, n))
    for width, u in inputs:
        block = np.block([[-a, q], [np.zeros((n, n)), a.T]]) * width
        whole = expm(block)
        step = whole[n:, n:].T
        held = expm(np.block([[a, (b @ u)[:, None]], [np.zeros((1, n + 1))]]) * width)[:n, n]
        phi, drive = step @ phi, step @ drive + held
        covariance = step @ covariance @ step.T + step @ whole[:n, n:]
    return phi, drive, covariance


def _write_lagged(substeps: int = 8, **fields: Any) -> dict[str, Any]:
    return {
        "name": "lagged",
        "form": "differential",
        "inputs": {"u": "1"},
        "states": {"x": "1"},
        "parameters": {
            "K": {"lower": 0.1, "upper": 10},
            "T": {"lower": 1, "upper": 10},
            "L": {"lower": 0, "upper": 2},
        },
        "equations": {"x": "(K*u(t - L) - x)/T"},
        "outputs": {"y": "x"},
        "initial": {"x": 0.4},
        "solver": {"substeps": substeps},
        **fields,
    }


def _list_lagged_steps(u: FloatArray) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """The lagged input changes once between two samples; the load is another state."""
    a = np.array([[-1 / CONSTANT, GAIN / CONSTANT], [0.0, -1 / CORRELATION]])
    b = np.array([[GAIN / CONSTANT], [0.0]])
    q = np.diag([0.0, 2 * LOAD**2 / CORRELATION])
    whole = int(LAG / PERIOD)
    part = LAG - whole * PERIOD
    steps = []
    for k in range(u.size):
        earlier, now = u[max(k - whole - 1, 0)], u[max(k - whole, 0)]
        pieces = [(part, np.array([earlier])), (PERIOD - part, np.array([now]))]
        steps.append(discretise(a, b, q, pieces))
    return steps


@pytest.mark.parametrize("missing", [(), (3, 4, 5, 6, 30)])
def test_a_load_behind_a_lag_has_its_exact_likelihood(missing: Sequence[int]) -> None:
    record = make_walk(missing=missing)
    problem = Problem.build(parse_model(_write_lagged()), [record], loss=Loss(noise_model="load"))
    theta = np.array([[GAIN, CONSTANT, LAG, LOAD, CORRELATION]])
    assert problem.free_names == ("K", "T", "L", "load[u]", "tau[u]")

    y = record.outputs[0].values[:, None]
    expected = filter_outputs(
        _list_lagged_steps(record.inputs[0].values),
        np.array([[1.0, 0.0]]),
        np.ones(1),
        np.array([0.4, 0.0]),
        np.diag([0.0, LOAD**2]),
        y,
    )

    predicted, deviations = problem.predict_ahead(theta)
    known = np.isfinite(y[:, 0])
    np.testing.assert_allclose(y[known, 0] - predicted[0, known], expected.innovations, atol=1e-6)
    np.testing.assert_allclose(deviations[0, known] ** 2, expected.variances, rtol=1e-6)
    assert problem.evaluate_fitness(theta)[0] == pytest.approx(expected.fitness, rel=1e-6)
    residuals = problem.compute_residuals(theta)[0]
    assert np.sqrt(np.mean(residuals**2)) == pytest.approx(expected.fitness, rel=1e-6)


def test_two_outputs_and_noise_in_two_states_have_their_exact_likelihood() -> None:
    document = _write_lagged(
        states={"x": "1", "v": "1"},
        equations={"x": "(v - x)/T", "v": "(K*u(t) - v)/L"},
        outputs={"y": "x", "z": "x + v"},
        initial={"x": 0.4, "v": -0.2},
    )
    record = make_walk(("y", "z"))
    weights = {"y": 2.0, "z": 0.5}
    problem = Problem.build(
        parse_model(document), [record], loss=Loss(noise_model="plant"), weights=weights
    )
    assert problem.free_names == ("K", "T", "L", "noise[x]", "noise[v]")
    theta = np.array([[GAIN, CONSTANT, LAG, 0.7, 1.3]])

    a = np.array([[-1 / CONSTANT, 1 / CONSTANT], [0.0, -1 / LAG]])
    b = np.array([[0.0], [GAIN / LAG]])
    steps = [
        discretise(a, b, np.diag([0.7**2, 1.3**2]), [(PERIOD, np.array([value]))])
        for value in record.inputs[0].values
    ]
    y = np.array([channel.values for channel in record.outputs]).T
    expected = filter_outputs(
        steps,
        np.array([[1.0, 0.0], [1.0, 1.0]]),
        np.array([2.0, 0.5]),
        np.array([0.4, -0.2]),
        np.zeros((2, 2)),
        y,
    )

    assert problem.evaluate_fitness(theta)[0] == pytest.approx(expected.fitness, rel=1e-5)
    _, deviations = problem.predict_ahead(theta)
    by_output = deviations[0].reshape(2, -1).T.ravel()
    np.testing.assert_allclose(by_output**2, expected.variances, rtol=1e-5)


def test_the_drift_of_a_sensor_is_a_load_at_its_output() -> None:
    document = _write_lagged(noise={"load": {"y": "estimate"}})
    record = make_walk()
    problem = Problem.build(parse_model(document), [record], loss=Loss(noise_model="load"))
    assert problem.free_names == ("K", "T", "L", "load[y]", "tau[y]")
    theta = np.array([[GAIN, CONSTANT, LAG, LOAD, CORRELATION]])
    free = Problem.build(parse_model(_write_lagged()), [record]).predict(theta[:, :3])[0]

    decay = np.exp(-PERIOD / CORRELATION)
    step = (np.array([[decay]]), np.zeros(1), np.array([[LOAD**2 * (1 - decay**2)]]))
    error = (record.outputs[0].values - free)[:, None]
    expected = filter_outputs(
        [step] * SAMPLES,
        np.ones((1, 1)),
        np.ones(1),
        np.zeros(1),
        np.array([[LOAD**2]]),
        error,
    )

    assert problem.evaluate_fitness(theta)[0] == pytest.approx(expected.fitness, rel=1e-6)


def test_a_document_names_the_places_of_noise() -> None:
    document = _write_lagged(noise={"plant": {"x": "estimate"}, "load": {"u": "estimate"}})
    model = parse_model(document)
    assert model.document["noise"] == document["noise"]
    assert parse_model(model.document) == model
    both = Problem.build(model, [make_walk()], loss=Loss(noise_model="plant"))
    assert both.free_names == ("K", "T", "L", "noise[x]", "load[u]", "tau[u]")
    load = Problem.build(model, [make_walk()], loss=Loss(noise_model="load"))
    assert load.free_names == ("K", "T", "L", "load[u]", "tau[u]")
    white = Problem.build(model, [make_walk()], loss=Loss(noise_model="white"))
    assert white.free_names == ("K", "T", "L")
    assert (white.is_free_run, both.is_free_run) == (True, False)
    assert list_plant_noise(model) == ("load", "plant", "drift")
    assert list_plant_noise(parse_model(_write_lagged())) == ()


def test_sizes_of_noise_are_changed_where_a_filter_is_asked_for() -> None:
    model, changes = parse_model(_write_lagged()), {"tau[u]": {"fixed": 5.0}}
    load = Problem.build(model, [make_walk()], parameters=changes, loss=Loss(noise_model="load"))
    assert "tau[u]" not in load.free_names
    with pytest.raises(InvalidSettings, match=r"Set loss: \{noise_model: load\}"):
        Problem.build(model, [make_walk()], parameters=changes)


@pytest.mark.parametrize(
    ("noise", "pointer", "text"),
    [
        ({"plant": {"w": "estimate"}}, "/noise/plant/w", "there is no such state"),
        ({"load": {"x": "estimate"}}, "/noise/load/x", "there is no such input or output"),
        ({"plant": {"x": 0.1}}, "/noise/plant/x", "need estimate"),
        ({"sensor": {"y": "estimate"}}, "/noise/sensor", "known are load, plant"),
        ({"plant": {"v": "estimate"}}, "/noise/plant/v", "no output depends on v"),
        ({"load": {"w": "estimate"}}, "/noise/load/w", "no output depends on w"),
        ("estimate", "/noise", "estimate"),
    ],
)
def test_noise_without_a_place_is_a_fault(noise: object, pointer: str, text: str) -> None:
    document = _write_lagged(
        noise=noise,
        inputs={"u": "1", "w": "1"} if "w" in pointer and "load" in pointer else {"u": "1"},
        states={"x": "1", "v": "1"},
        equations={
            "x": "(K*u(t - L) - x)/T",
            "v": "w - v" if "w" in pointer and "load" in pointer else "-v",
        },
        initial={"x": 0, "v": 0},
    )
    with pytest.raises(InvalidModel) as caught:
        parse_model(document)
    assert [fault.pointer for fault in caught.value.faults] == [pointer]
    assert text in caught.value.faults[0].detail


def test_irregular_samples_are_refused_with_the_way_out() -> None:
    random = np.random.default_rng(1)
    times = np.sort(random.random(SAMPLES)) * PERIOD * SAMPLES
    record = make_walk()
    irregular = Record(record.inputs, (Channel("y", times, np.sin(times)),))
    with pytest.raises(InvalidSettings, match="/solver/step"):
        Problem.build(parse_model(_write_lagged()), [irregular], loss=Loss(noise_model="load"))


def test_only_squares_and_no_other_predictions_go_with_noise_in_the_plant() -> None:
    for noise in ("plant", "load"):
        with pytest.raises(InvalidSettings, match="squares"):
            Loss("soft-l1", noise_model=noise)  # type: ignore[arg-type]
        loss = Loss(noise_model=noise)  # type: ignore[arg-type]
        with pytest.raises(InvalidSettings, match="simulation"):
            Problem.build(
                parse_model(_write_lagged()), [make_walk()], loss=loss, prediction="one-step"
            )


def test_an_individual_has_the_same_bits_alone_and_among_others() -> None:
    problem = Problem.build(
        parse_model(_write_lagged()), [make_walk(missing=(3,))], loss=Loss(noise_model="load")
    )
    random = np.random.default_rng(3)
    lower = np.array([p.lower for p in problem.free_parameters])
    upper = np.array([p.upper for p in problem.free_parameters])
    theta = lower * (upper / np.maximum(lower, 1e-3)) ** random.random((21, lower.size))
    together = problem.evaluate_fitness(theta)
    assert np.isfinite(together).any()
    alone = [problem.evaluate_fitness(one[None])[0] for one in theta]
    np.testing.assert_array_equal(together, alone)
    np.testing.assert_array_equal(
        problem.predict(theta), [problem.predict(one[None])[0] for one in theta]
    )


def test_a_plant_at_rest_was_moved_by_its_load_before_the_record() -> None:
    record = make_walk()
    model = parse_model(_write_lagged(initial="steady"))
    problem = Problem.build(model, [record], loss=Loss(noise_model="load"))
    theta = np.array([[GAIN, CONSTANT, LAG, LOAD, CORRELATION]])

    a = np.array([[-1 / CONSTANT, GAIN / CONSTANT], [0.0, -1 / CORRELATION]])
    q = np.diag([0.0, 2 * LOAD**2 / CORRELATION])
    u = record.inputs[0].values
    expected = filter_outputs(
        _list_lagged_steps(u),
        np.array([[1.0, 0.0]]),
        np.ones(1),
        np.array([GAIN * u[0], 0.0]),
        solve_continuous_lyapunov(a, -q),
        record.outputs[0].values[:, None],
    )

    assert problem.evaluate_fitness(theta)[0] == pytest.approx(expected.fitness, rel=1e-6)


def test_a_start_behind_an_integrator_is_known_and_its_load_is_stationary() -> None:
    document = _write_lagged(equations={"x": "K*u(t - L)/T"})
    problem = Problem.build(parse_model(document), [make_walk()], loss=Loss(noise_model="load"))
    theta = np.array([[GAIN, CONSTANT, LAG, LOAD, CORRELATION]])
    _, deviations = problem.predict_ahead(theta)
    assert deviations[0, 0] == 1.0
    assert np.all(deviations[0, 1:] > 1.0)
