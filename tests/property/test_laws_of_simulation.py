"""Laws that hold for every simulation of a population."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.model import Model
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from tests.support.library.small_models import (
    difference,
    differential,
    duffing,
    individuals,
    lag_element,
    record,
    with_output,
)

LAGGED = differential({"x": "u(t) - b*x - c*x(t - L) - 0.2*x(t - 3*L)"}, "x + 0.1*x(t - 2*L)")
MODELS = [duffing(), lag_element(), lag_element(solver={"method": "euler", "substeps": 2}), LAGGED]


@pytest.mark.parametrize("model", MODELS)
def test_permuting_individuals_permutes_fitness_bit_for_bit(model: Model) -> None:
    problem = Problem.build(model, [record(40)])
    theta = individuals(problem, 37)
    order = np.random.default_rng(3).permutation(37)
    np.testing.assert_array_equal(
        problem.evaluate_fitness(theta)[order], problem.evaluate_fitness(theta[order])
    )
    np.testing.assert_array_equal(problem.predict(theta)[order], problem.predict(theta[order]))


@pytest.mark.parametrize("model", MODELS)
def test_an_individual_has_the_same_bits_alone_and_among_others(model: Model) -> None:
    problem = Problem.build(model, [record(40)])
    theta = individuals(problem, 35)
    alone = [problem.evaluate_fitness(one[np.newaxis])[0] for one in theta]
    np.testing.assert_array_equal(problem.evaluate_fitness(theta), alone)


@pytest.mark.parametrize(
    ("model", "irregular"), [*((model, False) for model in MODELS), (MODELS[1], True)]
)
def test_the_free_run_of_the_true_model_gives_zero_error(model: Model, irregular: bool) -> None:
    blank = record(40, irregular=irregular)
    theta = individuals(Problem.build(model, [blank]), 5)
    for one in theta[2:]:
        truth = Problem.build(model, [blank]).predict(one[np.newaxis])[0]
        problem = Problem.build(model, [with_output(blank, truth)])
        assert problem.evaluate_fitness(one[np.newaxis])[0] == 0.0


@pytest.mark.parametrize("hold", ["first", "zero", "band-limited"])
@pytest.mark.parametrize("samples", [1, 7])
def test_a_lag_delays_the_output_of_a_linear_system_by_itself(hold: str, samples: int) -> None:
    """Whole samples: the lagged response is the one without lag, shifted."""
    excited = record(60, hold=hold)  # type: ignore[arg-type]
    u = excited.inputs[0]
    quiet = np.where(np.arange(60) < 10, 0.0, u.values)
    excited = Record((Channel("u", u.times, quiet, hold=u.hold),), excited.outputs)
    problem = Problem.build(lag_element(), [excited])
    lag = samples * 0.05
    prompt, late = problem.predict(np.array([[1.0, 0.0, 0.4], [1.0, lag, 0.4]]))
    tolerance = {"first": 1e-9, "zero": 5e-2, "band-limited": 1e-3}[hold]
    np.testing.assert_allclose(late[samples:], prompt[:-samples], atol=tolerance)


def test_fitness_is_continuous_in_the_lag_down_to_none() -> None:
    model = differential({"x": "v", "v": "u(t-L) - c*v(t-L) - b*x(t-L)"}, "x(t-L)")
    problem = Problem.build(model, [record(40)])
    lags = np.array([0.0, 1e-9, 0.025 - 1e-9, 0.025, 0.025 + 1e-9, 0.05 - 1e-9, 0.05, 0.05 + 1e-9])
    theta = np.column_stack([np.full(8, 0.3), lags, np.full(8, 4.0)])
    fitness = problem.evaluate_fitness(theta)
    for i in (0, 2, 3, 5, 6):
        assert fitness[i] == pytest.approx(fitness[i + 1], abs=1e-7)


def test_without_lag_the_integration_agrees_with_scipy() -> None:
    model = differential(
        {"x": "v", "v": "u(t) - c*v - b*x - 0.5*x**3"},
        "x",
        initial={"x": 0.3, "v": -0.2},
        solver={"substeps": 4},
    )
    times = 0.05 * np.arange(101)
    u = np.interp(times, [0.0, 1.0, 2.5, 5.0], [0.0, 1.0, -1.0, 0.5])
    found = simulate(model, [Channel("u", times, u)], {"c": 0.3, "L": 0, "b": 4}, times=times)

    def slope(t: float, x: np.ndarray) -> list[float]:
        return [x[1], np.interp(t, times, u) - 0.3 * x[1] - 4 * x[0] - 0.5 * x[0] ** 3]

    expected = solve_ivp(
        slope, (0, 5), [0.3, -0.2], t_eval=times, rtol=1e-10, atol=1e-12, max_step=0.05
    )
    np.testing.assert_allclose(found.channels[0].values, expected.y[0], atol=2e-8)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_delay_differential_equation_has_its_known_solution(interpolation: str) -> None:
    """dx/dt = -x(t - 1) from x = 1: a polynomial on each interval of length 1."""
    model = differential(
        {"x": "-x(t - 1)"}, "x", initial={"x": 1}, solver={"interpolation": interpolation}
    )
    times = 0.01 * np.arange(201)
    values = {"c": 0, "L": 0, "b": 1}
    found = simulate(model, [Channel("u", times, times)], values, times=times)
    t = times
    expected = np.where(t <= 1, 1 - t, 1 - t + (t - 1) ** 2 / 2)
    np.testing.assert_allclose(found.channels[0].values, expected, atol=1e-9)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_a_history_function_gives_the_known_solution(interpolation: str) -> None:
    """dx/dt = -x(t - 1) by steps: the integral of the history, then of that solution."""
    parameters = {name: {"lower": -2, "upper": 2} for name in "ab"}
    a, b, t = 1.3, 0.7, 0.1 * np.arange(21)

    def solve(history: str) -> FloatArray:
        model = differential(
            {"x": "-x(t - 1)"},
            "x",
            inputs={},
            parameters=parameters,
            initial={},
            history={"x": history},
            solver={"interpolation": interpolation, "substeps": 10},
        )
        return simulate(model, [], {"a": a, "b": b}, times=t).channel("y").values

    expected = a - a * (np.exp(b * (t - 1)) - np.exp(-b)) / b
    np.testing.assert_allclose(solve("a*exp(b*t)")[t <= 1], expected[t <= 1], atol=1e-10)
    if interpolation == "cubic":  # the solution is a parabola, then a cubic: read without error
        s = t - 1
        first = a - a * t - b * (t**2 / 2 - t)
        second = b / 2 - (a * s - a * s**2 / 2 - b * (s**3 / 6 - s**2 / 2))
        expected = np.where(t <= 1, first, second)
        np.testing.assert_allclose(solve("a + b*t"), expected, atol=1e-12)


def largest_errors(interpolation: str, lag: float) -> np.ndarray:
    """Errors of dx/dt = g(t) - x(t - L) with steps 0.2, 0.1, …; g makes x = t⁶ exp(-t)."""
    rate = "6*t**5*exp(-t) - t**6*exp(-t) + max(t - L, 0)**6*exp(L - t) - x(t - L)"
    solver = {"interpolation": interpolation}
    model = differential({"x": rate}, "x", inputs={}, initial={"x": 0}, solver=solver)
    found = []
    for intervals in (40, 80, 160, 320):
        times = np.linspace(0.0, 8.0, intervals + 1)
        x = simulate(model, [], {"c": 0, "L": lag, "b": 1}, times=times).channels[0].values
        found.append(np.max(np.abs(x - times**6 * np.exp(-times))))
    return np.array(found)


@pytest.mark.parametrize(("interpolation", "order"), [("linear", 2), ("cubic", 4)])
def test_halving_the_step_shows_the_order_of_the_interpolation(
    interpolation: str, order: int
) -> None:
    errors = largest_errors(interpolation, 0.3137)
    mean_order = np.log2(errors[0] / errors[-1]) / 3
    assert order - 0.5 < mean_order < order + 0.5


def test_a_lag_below_one_step_is_read_by_a_parabola() -> None:
    """At any step the lag is a fifth of it: the order is three, with a line it is two."""
    steps = (0.2, 0.1, 0.05)
    errors = [largest_errors("cubic", 0.2 * step)[i] for i, step in enumerate(steps)]
    assert np.log2(errors[0] / errors[2]) / 2 > 2.5


@pytest.mark.parametrize(("interpolation", "order"), [("linear", 2), ("cubic", 4)])
def test_jumps_of_an_input_between_two_steps_do_not_lower_the_order(
    interpolation: str, order: int
) -> None:
    """The slopes of a step are those before a jump at its end, and after one at its start."""
    model = differential(
        {"x": "u - b*x - c*x(t - L)"}, "x", solver={"interpolation": interpolation}
    )
    held = Channel("u", np.arange(9.0), np.array([0.0, 1, -1, -1, 1, 0, 1, 1, 0]), hold="zero")

    def run(step: float) -> np.ndarray:
        times = np.linspace(0.0, 8.0, round(8 / step) + 1)
        found = simulate(model, [held], {"c": 1.0, "L": 0.4, "b": 2.0}, times=times)
        return found.channels[0].values[:: round(0.2 / step)]

    errors = [np.max(np.abs(run(step) - run(0.003125))) for step in (0.2, 0.1, 0.05)]
    assert order - 0.5 < np.log2(errors[0] / errors[2]) / 2 < order + 0.5


def test_a_long_record_gives_what_its_beginning_gives() -> None:
    """The history's buffer is moved many times in a long record, and never in a short one."""
    model, long = duffing(), record(5000)
    values = {"c": 0.2, "L": 0.63, "b": 5.0, "a": 1.0}
    times = long.inputs[0].times
    whole = simulate(model, long.inputs, values, times=times).channels[0].values
    part = simulate(model, long.inputs, values, times=times[:300]).channels[0].values
    np.testing.assert_array_equal(whole[:300], part)
    fields = {"interpolation": "linear"}
    filtered = difference({"x": "0.9*x(k-1) - 0.02*x(k-1-L/h) + u(k)"}, "x", solver=fields)
    found = simulate(filtered, long.inputs, {"c": 0, "L": 0.63, "b": 0}, times=times)
    x, u = found.channels[0].values, long.inputs[0].values
    lagged = 0.4 * x[987:4986] + 0.6 * x[986:4985]  # 0.63 s are 12.6 samples
    expected = 0.9 * x[999:4998] - 0.02 * lagged + u[1000:4999]
    np.testing.assert_allclose(x[1000:4999], expected, rtol=1e-9, atol=1e-9)


def test_a_lag_of_whole_steps_reads_the_state_as_it_was() -> None:
    """Also after the history's buffer was moved, which a long record does many times."""
    outputs = {"y": "x", "z": "x(t - L)", "w": "x(t - 2*L)"}
    model = differential({"x": "u(t) - b*x - c*x(t - L)"}, "x", outputs=outputs)
    long = record(5000)
    values = {"c": 2.0, "L": 0.6, "b": 1.0}
    found = simulate(model, long.inputs, values, times=long.inputs[0].times)
    y, once, twice = (channel.values for channel in found.channels)
    for late, samples in ((once, 12), (twice, 24)):
        np.testing.assert_allclose(late[samples:], y[:-samples], rtol=1e-9, atol=1e-9)


def test_a_diverging_individual_has_infinite_fitness_and_harms_nobody() -> None:
    model = difference({"x": "b*x(k-1)**2 + c*u(k)"}, "min(x, 5)")
    problem = Problem.build(model, [record(60)])
    theta = np.array([[0.5, 0.0, 9.0], [0.5, 0.0, 0.1]])
    fitness = problem.evaluate_fitness(theta)
    assert fitness[0] == np.inf
    assert fitness[1] == problem.evaluate_fitness(theta[1:])[0] < np.inf
