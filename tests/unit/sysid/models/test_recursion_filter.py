"""The filter of a recursion beside a Kalman filter of matrices, written for it alone."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from sysid.core.errors import InvalidModel
from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.models.kalman_filter import list_plant_noise
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from tests.support.library.walking_records import PERIOD, SAMPLES, make_walk
from tests.unit.sysid.models.test_kalman_filter import filter_outputs

A, B, G, LAG, NOISE = 1.5, -0.7, 0.4, 0.75, 0.6


def _write(**fields: Any) -> dict[str, Any]:
    return {
        "name": "recursion",
        "form": "difference",
        "inputs": {"u": "1"},
        "states": {"x": "1"},
        "parameters": {
            "a": {"lower": 0, "upper": 2},
            "b": {"lower": -1, "upper": 1},
            "g": {"lower": 0, "upper": 2},
            "L": {"lower": 0, "upper": 2},
        },
        "equations": {"x": "a*x(k-1) + b*x(k-2) + g*u(k-1 - L/h)"},
        "outputs": {"y": "x"},
        "initial": {"x": 0.4},
        "noise": {"plant": {"x": "estimate"}},
        **fields,
    }


def _read_input(record: Record, k: int) -> float:
    """The input of sample k of the recursion: three samples lagged, and one of the equation."""
    return float(record.inputs[0].values[max(k - 1 - round(LAG / PERIOD), 0)])


TANGENT = np.array([[A, B], [1.0, 0.0]])
THETA = np.array([[A, B, G, LAG, NOISE]])
Step = tuple[FloatArray, FloatArray, FloatArray]


def _list_steps(record: Record, first: list[Step]) -> list[Step]:
    """Steps from each sample to the next one; `first` are those to the first samples."""
    noise = np.diag([NOISE**2, 0.0])
    later = [
        (TANGENT, np.array([G * _read_input(record, k), 0.0]), noise)
        for k in range(len(first) + 1, SAMPLES + 1)
    ]
    return [*first, *later]


HELD: Step = (np.array([[1.0, 0.0], [1.0, 0.0]]), np.zeros(2), np.zeros((2, 2)))


@pytest.mark.parametrize("missing", [(), (3, 4, 5, 30)])
def test_noise_in_a_linear_recursion_has_its_exact_likelihood(missing: tuple[int, ...]) -> None:
    record = make_walk(missing=missing)
    problem = Problem.build(parse_model(_write()), [record], loss=Loss(noise_model="plant"))
    assert problem.free_names == ("a", "b", "g", "L", "noise[x]")
    y = record.outputs[0].values[:, None]
    start = np.array([0.4, 0.4])
    expected = filter_outputs(
        _list_steps(record, [HELD]),
        np.array([[1.0, 0.0]]),
        np.ones(1),
        start,
        np.zeros((2, 2)),
        y,
    )

    predicted, deviations = problem.predict_ahead(THETA)
    known = np.isfinite(y[:, 0])
    np.testing.assert_allclose(y[known, 0] - predicted[0, known], expected.innovations, rtol=1e-9)
    np.testing.assert_allclose(deviations[0, known] ** 2, expected.variances, rtol=1e-9)
    assert problem.evaluate_fitness(THETA)[0] == pytest.approx(expected.fitness, rel=1e-9)


def test_a_measured_start_has_the_error_of_its_samples() -> None:
    record = make_walk()
    model = parse_model(_write(initial={"x": "measured"}))
    problem = Problem.build(model, [record], loss=Loss(noise_model="plant"))
    y = record.outputs[0].values
    expected = filter_outputs(
        _list_steps(record, [])[2:],
        np.array([[1.0, 0.0]]),
        np.ones(1),
        TANGENT @ y[1::-1] + [G * _read_input(record, 2), 0.0],
        TANGENT @ TANGENT.T + np.diag([NOISE**2, 0.0]),
        y[2:, None],
    )

    assert problem.n_scored == SAMPLES - 2
    assert problem.evaluate_fitness(THETA)[0] == pytest.approx(expected.fitness, rel=1e-6)


def test_a_recursion_at_rest_was_moved_by_its_noise_before_the_record() -> None:
    record = make_walk()
    model = parse_model(_write(initial="steady"))
    problem = Problem.build(model, [record], loss=Loss(noise_model="plant"))
    spread = solve_discrete_lyapunov(TANGENT, np.diag([NOISE**2, 0.0]))

    predicted, deviations = problem.predict_ahead(THETA)

    rest = G * record.inputs[0].values[0] / (1 - A - B)
    assert predicted[0, 0] == pytest.approx(rest, rel=1e-9)
    assert deviations[0, 0] ** 2 == pytest.approx(1 + spread[0, 0], rel=1e-9)


def test_without_noise_of_the_sensor_predictions_start_from_measured_values() -> None:
    record = make_walk()
    noise = {"noise[x]": {"fixed": 1e4}}
    for initial, first in (("measured", 2), (0.4, 4)):  # a given start is no measured value
        model = parse_model(_write(initial={"x": initial}))
        ahead = Problem.build(model, [record], prediction="one-step")
        filtered = Problem.build(
            model, [record], loss=Loss(noise_model="plant"), parameters=noise, skip=2
        )
        values, _ = filtered.predict_ahead(THETA[:, :4])
        np.testing.assert_allclose(
            values[0, first:], ahead.predict(THETA[:, :4])[0, first:], atol=1e-6
        )


def test_a_load_of_a_recursion_is_an_ornstein_uhlenbeck_process() -> None:
    record = make_walk()
    load, time = 1.7, 4.0
    model = parse_model(_write(noise={"load": {"u": "estimate"}}))
    problem = Problem.build(model, [record], loss=Loss(noise_model="load"))
    assert problem.free_names == ("a", "b", "g", "L", "load[u]", "tau[u]")
    kept = np.exp(-PERIOD / time)
    noise = np.diag([0.0, 0.0, load**2 * (1 - kept**2)])
    moved = np.array([[A, B, G], [1.0, 0.0, 0.0], [0.0, 0.0, kept]])
    held = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, kept]])
    steps = [(held, np.zeros(3), noise)]
    steps += [
        (moved, np.array([G * _read_input(record, k), 0.0, 0.0]), noise)
        for k in range(2, SAMPLES + 1)
    ]
    expected = filter_outputs(
        steps,
        np.array([[1.0, 0.0, 0.0]]),
        np.ones(1),
        np.array([0.4, 0.4, 0.0]),
        np.diag([0.0, 0.0, load**2]),
        record.outputs[0].values[:, None],
    )

    theta = np.array([[A, B, G, LAG, load, time]])
    assert problem.evaluate_fitness(theta)[0] == pytest.approx(expected.fitness, rel=1e-9)


def test_noise_enters_states_that_are_read_at_the_same_sample() -> None:
    document = _write(
        states={"x": "1", "w": "1"},
        equations={"x": "a*x(k-1) + g*w", "w": "b*w(k-1) + 0.2*x(k-2) + L*u(k)"},
        outputs={"y": "x + w(k-1)", "z": "w"},
        initial={"x": 0.4, "w": -0.2},
        noise={"plant": {"x": "estimate", "w": "estimate"}},
    )
    record = make_walk(("y", "z"))
    weights = {"y": 2.0, "z": 0.5}
    problem = Problem.build(
        parse_model(document), [record], loss=Loss(noise_model="plant"), weights=weights
    )
    theta = np.array([[0.9, B, G, LAG, 0.6, 1.3]])
    assert problem.free_names == ("a", "b", "g", "L", "noise[x]", "noise[w]")
    # states x, w, x[1], w[1]; w is computed before x
    w = np.array([0.0, B, 0.2, 0.0])
    moved = np.array([np.array([0.9, 0, 0, 0]) + G * w, w, [1.0, 0, 0, 0], [0, 1.0, 0, 0]])
    enter = np.array([[1.0, G], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    noise = enter @ np.diag([0.6**2, 1.3**2]) @ enter.T
    held = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [1.0, 0, 0, 0], [0, 1.0, 0, 0]])
    steps = [(held, np.zeros(4), np.zeros((4, 4)))]
    u = record.inputs[0].values
    steps += [(moved, LAG * u[k] * np.array([G, 1.0, 0.0, 0.0]), noise) for k in range(2, SAMPLES)]
    expected = filter_outputs(
        [*steps, steps[-1]],
        np.array([[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0]]),
        np.array([2.0, 0.5]),
        np.array([0.4, -0.2, 0.4, -0.2]),
        np.zeros((4, 4)),
        np.array([channel.values for channel in record.outputs]).T,
    )

    assert problem.evaluate_fitness(theta)[0] == pytest.approx(expected.fitness, rel=1e-9)


def _write_delayed(upper: float, **fields: Any) -> dict[str, Any]:
    parameters = {**_write()["parameters"], "L": {"lower": 0, "upper": upper}}
    equation = "a*x(k-1) + b*x(k-1 - L/h) + g*u(k-1)"
    return _write(equations={"x": equation}, parameters=parameters, **fields)


@pytest.mark.parametrize("history", ["constant", "zero"])
def test_a_short_unknown_lag_of_a_state_has_its_exact_likelihood(history: str) -> None:
    record, lag = make_walk(), 1.65  # 6.6 samples
    theta = np.array([[0.7, B, G, lag, NOISE]])
    moved = np.eye(8, k=-1)
    moved[0] = [0.7, *[0.0] * 5, 0.4 * B, 0.6 * B]
    noise = np.diag([NOISE**2, *[0.0] * 7])
    u = record.inputs[0].values
    steps = [(moved, G * value * np.eye(8)[0], noise) for value in u]
    expected = filter_outputs(
        steps,
        np.eye(8)[:1],
        np.ones(1),
        np.array([0.4, *[0.4 if history == "constant" else 0.0] * 7]),
        np.zeros((8, 8)),
        record.outputs[0].values[:, None],
    )

    def build(upper: float, **changes: Any) -> Problem:
        return Problem.build(
            parse_model(_write_delayed(upper, solver={"history": history})),
            [record],
            loss=Loss(noise_model="plant"),
            parameters=changes,
        )

    exact = build(1.7).evaluate_fitness(theta)[0]
    assert exact == pytest.approx(expected.fitness, rel=1e-9)
    assert build(20.0, L={"upper": 1.7}).evaluate_fitness(theta)[0] == exact
    tied = build(1.7, L={"tied": "1.2 - 0.5*g"})  # whose values its bounds do not limit
    assert "x[3]" not in [state.name for state in tied.model.states]
    for longer in (build(2.0), build(1.7, L={"upper": 2.0})):
        assert "x[3]" not in [state.name for state in longer.model.states]
        assert longer.evaluate_fitness(theta)[0] == pytest.approx(exact, rel=0.1)
        assert longer.evaluate_fitness(theta)[0] != pytest.approx(exact, rel=1e-6)


def test_the_documents_of_recursions_name_their_places_of_noise() -> None:
    model = parse_model(_write())
    assert model.document["noise"] == {"plant": {"x": "estimate"}}
    assert parse_model(model.document) == model
    assert list_plant_noise(model) == ("plant", "drift")
    with pytest.raises(InvalidModel, match="no output depends on w"):
        parse_model(
            _write(
                states={"x": "1", "w": "1"},
                equations={"x": "a*x(k-1) + g*u(k-1 - L/h)", "w": "b*w(k-1)"},
                noise={"plant": {"w": "estimate"}},
            )
        )


def test_an_individual_has_the_same_bits_alone_and_among_others() -> None:
    model = parse_model(_write(initial={"x": "measured"}))
    problem = Problem.build(model, [make_walk(missing=(3,))], loss=Loss(noise_model="plant"))
    random = np.random.default_rng(3)
    lower = np.array([p.lower for p in problem.free_parameters])
    upper = np.array([p.upper for p in problem.free_parameters])
    theta = lower + (upper - lower) * random.random((21, lower.size))
    together = problem.evaluate_fitness(theta)
    assert np.isfinite(together).any()
    alone = [problem.evaluate_fitness(one[None])[0] for one in theta]
    np.testing.assert_array_equal(together, alone)
