"""A kernel computes what its plain twin computes, for every form, method and interpolation."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid.core.settings import Loss
from sysid.models.model import Model
from sysid.simulation.problem import Problem
from tests.support.library import plain_twins
from tests.support.library.small_models import (
    difference,
    differential,
    individuals,
    record,
    with_output,
)
from tests.support.profiles import scale_examples

LAGGED = {
    "x": "v",
    "v": "u(t) + u(t-L) - c*v(t-L) - b*x - 0.5*x**3 - 0.2*x(t-2*L)"
    " + 0.1*sin(t)*where(x > 0 and v < 1, 1, -1)",
}
RECURSION = {
    "w": "0.9*w(k-1) + 0.1*u(k)",
    "x": "1.5*x(k-1) - 0.7*x(k-2) - 0.01*c*x(k-1-L/h)**3 + 0.02*x(k-2-L/h) + h*u(k-1)"
    " + h*u(k-L/h) + 0.1*w(k-L/h) + 0.01*w + 0.001*x(k-12) + 0.01*tanh(k*x(k-1))",
}


def assert_equal(problem: Problem, one_step: bool = False) -> None:
    theta = individuals(problem, 4)
    expected = np.array([plain_twins.predictions(problem, one, one_step) for one in theta])
    np.testing.assert_allclose(problem.predict(theta), expected, rtol=1e-9, atol=1e-11)
    if not one_step:
        costs = [plain_twins.fitness(problem, one) for one in theta]
        np.testing.assert_allclose(problem.evaluate_fitness(theta), costs, rtol=1e-9)


@pytest.mark.parametrize(
    ("interpolation", "history"),
    [*product(("linear", "cubic", "nearest"), ("constant", "zero"))],
)
def test_a_recursion_equals_its_twin(interpolation: str, history: str) -> None:
    solver = {"interpolation": interpolation, "history": history}
    model = difference(RECURSION, "x + 0.1*x(k - L/h)", solver=solver)
    assert_equal(Problem.build(model, [record(26)]))


@pytest.mark.parametrize("hold", ["first", "zero"])
def test_a_recursion_finer_than_its_samples_equals_its_twin(hold: Any) -> None:
    start = {"x": "measured", "w": 0}
    guessed = {"x": {"lower": -1, "upper": 1}, "w": 0.1}
    model = difference(RECURSION, "x + 0.1*x(k - L/h)", solver={"substeps": 3}, initial=guessed)
    assert_equal(Problem.build(model, [record(14, hold=hold)]))
    model = difference(RECURSION, "x", solver={"substeps": 3}, initial=start)
    problem = Problem.build(model, [record(14, hold=hold)])
    assert_equal(problem)
    found = problem.predict(individuals(problem, 3))[:, : model.memory // 3]
    given = np.tile(record(14).outputs[0].values[:4], (3, 1))
    np.testing.assert_allclose(found, given, rtol=1e-14)


@pytest.mark.parametrize("method", ["rk4", "euler", "semi-implicit"])
@pytest.mark.parametrize(
    ("interpolation", "substeps", "irregular", "hold"),
    [
        ("linear", 1, False, "first"),
        ("linear", 3, True, "zero"),
        ("cubic", 2, False, "band-limited"),
        ("nearest", 2, True, "first"),
    ],
)
def test_a_differential_model_equals_its_twin(
    method: str, interpolation: str, substeps: int, irregular: bool, hold: Any
) -> None:
    solver = {"method": method, "interpolation": interpolation, "substeps": substeps}
    start = {"x": 0.3, "v": {"lower": -1, "upper": 1}}
    model = differential(LAGGED, "x(t-L) + v", solver=solver, initial=start)
    assert_equal(Problem.build(model, [record(24, irregular=irregular, hold=hold)]))


@pytest.mark.parametrize(
    ("method", "interpolation", "hold"),
    [("rk4", "cubic", "first"), ("rk4", "linear", "zero"), ("euler", "nearest", "first")],
)
def test_a_lag_that_changes_with_an_input_equals_its_twin(
    method: str, interpolation: str, hold: Any
) -> None:
    equations = {
        "x": "u(t - L*(1 + 0.5*tanh(u))) - b*x(t - L)",
        "v": "table(x, [-1, 0, 2], [c, 0, 1])",
    }
    solver = {"method": method, "interpolation": interpolation, "substeps": 2}
    model = differential(
        equations, "x + pchip(u(t - 0.3/(2 + u)), [-1, 0, 1], [0, c, b])", solver=solver
    )
    assert_equal(Problem.build(model, [record(24, hold=hold)]))
    if method != "euler":
        return
    recursion = {
        "x": "0.5*x(k-1) + u(k-1 - L/h*(1 + 0.5*tanh(u))) + mod(u(k - abs(u)), 3) + mod(-1e17*c, 3)"
    }
    model = difference(recursion, "x", solver={"interpolation": "linear"})
    assert_equal(Problem.build(model, [record(24, hold=hold)]))


@pytest.mark.parametrize(
    ("method", "interpolation", "step"),
    [
        ("rk4", "cubic", 0.017),
        ("rk4", "linear", "sample"),
        ("euler", "cubic", "sample"),
        ("semi-implicit", "nearest", "sample"),
    ],
)
def test_a_history_function_equals_its_twin(method: str, interpolation: str, step: Any) -> None:
    solver = {"method": method, "interpolation": interpolation, "step": step, "substeps": 2}
    history = {"x": "c*exp(b*t/9) - t**2", "v": "where(t < -0.1, c, sin(9*t)) + 0.3"}
    start = {"v": {"lower": -1, "upper": 1}}
    model = differential(LAGGED, "x(t-L) + v", solver=solver, history=history, initial=start)
    assert_equal(Problem.build(model, [record(24, hold="zero"), record(20, irregular=True)]))
    if interpolation == "linear":
        assert_equal(Problem.build(model, [record(24)], prediction="one-step"), one_step=True)


SWITCHING = {
    "x": "where(t > c and t < c + L, sqrt(t - c), where(mod(t - L, 0.2*c + 0.11) <= 0.1, v, 0)) + u"
    " - b*x(t - 0.5*L) + 0.1*u(t - L*(1 + 0.5*tanh(u)))",
    "v": "max(t - c, 0, x)*sign(c - t) + abs(t - 2*L) + floor(3*t) + clip(t, L, c) - v(t - L)"
    " + u(t - L) + table(t - L, [0, 0.2, 0.5], [0, b, 1]) + pchip(t, [0.33, 0.77], [c, 0]) - x",
}


@pytest.mark.parametrize("method", ["rk4", "euler", "semi-implicit"])
@pytest.mark.parametrize(
    ("interpolation", "step", "hold"),
    [("linear", "sample", "zero"), ("cubic", 0.017, "first"), ("nearest", 0.034, "zero")],
)
def test_a_step_divided_at_switches_in_time_equals_its_twin(
    method: str, interpolation: str, step: Any, hold: Any
) -> None:
    solver = {"method": method, "interpolation": interpolation, "step": step, "substeps": 2}
    history = {"v": "where(t < -0.1, c, sin(9*t)) + 0.3"}
    model = differential(
        SWITCHING, "x(t-L) + v", solver=solver, history=history, initial={"x": 0.3}
    )
    assert_equal(Problem.build(model, [record(16, hold=hold)]))
    if interpolation == "linear":
        assert_equal(Problem.build(model, [record(16)], prediction="one-step"), one_step=True)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_one_step_prediction_equals_its_twin(interpolation: str) -> None:
    model = difference(RECURSION, "x", solver={"interpolation": interpolation})
    assert_equal(Problem.build(model, [record(24)], prediction="one-step"), one_step=True)
    model = differential(LAGGED, "x", solver={"interpolation": interpolation, "substeps": 2})
    assert_equal(Problem.build(model, [record(24)], prediction="one-step"), one_step=True)


def test_a_measured_start_gives_the_first_samples_of_a_recursion() -> None:
    model = difference(RECURSION, "x", initial={"x": "measured", "w": 0})
    problem = Problem.build(model, [record(24)])
    assert_equal(problem)
    found = problem.predict(individuals(problem, 3))[:, : model.memory]
    np.testing.assert_array_equal(found, np.tile(record(24).outputs[0].values[:12], (3, 1)))


def test_several_experiments_and_outputs_equal_their_twin() -> None:
    model = differential(
        LAGGED,
        "x",
        outputs={"y": "x", "z": "v - u(t-L)"},
        initial={"x": {"lower": -1, "upper": 1}, "v": 0.1},
    )
    records = [record(20, outputs=("y", "z")), record(25, 0.04, seed=5, outputs=("z", "y"))]
    problem = Problem.build(model, records, skip=3)
    assert [p.name for p in problem.free_parameters] == ["c", "L", "b", "x(0)", "x(0)[2]"]
    assert_equal(problem)


_leaves = st.sampled_from(["x(k-1)", "u(k)", "c", "L", "0.5", "h", "k", "x(k-1-L/h)", "u(k-1-L/h)"])
_functions = ("sin", "cos", "tanh", "atan", "abs", "sign", "exp")


def _grown(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    return st.one_of(
        st.builds("({} {} {})".format, inner, st.sampled_from("+-*"), inner),
        st.builds("{}({})".format, st.sampled_from(_functions), inner),
        st.builds("{}({}, {})".format, st.sampled_from(("min", "max")), inner, inner),
        st.builds("where({} < {}, {}, {})".format, inner, inner, inner, inner),
        st.builds("(tanh({})**{})".format, inner, st.sampled_from((2, 3, 5))),
        st.builds("(-({}))".format, inner),
    )


@settings(max_examples=scale_examples(15))
@given(st.recursive(_leaves, _grown, max_leaves=6))
def test_any_expression_equals_its_twin(text: str) -> None:
    model: Model = difference({"x": f"0.5*x(k-1) + 0.3*tanh({text})"}, "x")
    assert_equal(Problem.build(model, [record(24)]))


FILTERED = {
    "x": "v - 0.1*x",
    "v": "u(t) + u(t-L) - c*v(t-L) - b*tanh(x) - 0.5*x**3 - 0.2*x(t-2*L)"
    " + 0.1*sin(t)*where(x > 0 and v < 1, x, -1)*sqrt(1 + v**2)",
}


@pytest.mark.parametrize("noise", ["load", "plant"])
@pytest.mark.parametrize("method", ["rk4", "euler", "semi-implicit"])
@pytest.mark.parametrize(
    ("interpolation", "substeps", "hold"),
    [("linear", 1, "first"), ("cubic", 3, "zero"), ("nearest", 2, "zero")],
)
def test_a_kalman_filter_equals_its_twin(
    noise: Any, method: str, interpolation: str, substeps: int, hold: Any
) -> None:
    solver = {"method": method, "interpolation": interpolation, "substeps": substeps}
    start = {"x": 0.3, "v": {"lower": -1, "upper": 1}}
    model = differential(FILTERED, "x + 0.1*v**2 + 0.1*x(t-L)", solver=solver, initial=start)
    gaps = record(24, hold=hold)
    values = gaps.outputs[0].values.copy()
    values[[3, 4, 11]] = np.nan
    records = [record(20, hold=hold), with_output(gaps, values)]
    noises = {"load[u]": (0.1, 10), "tau[u]": (0.1, 1), "noise[x]": (0.1, 3), "noise[v]": (0.1, 3)}
    bounds = {n: {"lower": low, "upper": high} for n, (low, high) in noises.items()}
    names = ("load[u]", "tau[u]") if noise == "load" else ("noise[x]", "noise[v]")
    parameters = {name: bounds[name] for name in names}
    loss = Loss(noise_model=noise)
    problem = Problem.build(model, records, loss=loss, skip=2, parameters=parameters)
    theta = individuals(problem, 4)
    found = problem.predict(theta)
    expected = np.array([plain_twins.predictions(problem, one) for one in theta])
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)
    costs = [plain_twins.fitness(problem, one) for one in theta]
    np.testing.assert_allclose(problem.evaluate_fitness(theta), costs, rtol=1e-8)
    kept = [i for i, name in enumerate(problem.free_names) if name not in parameters]
    white = Problem.build(model, records, skip=2).predict(theta[:, kept])
    is_finite = np.isfinite(costs)  # Euler steps may lose the sign of a variance
    assert np.sum(is_finite) >= 2
    assert np.all(np.max(np.abs(found - white)[is_finite], axis=1) > 0.01)


@pytest.mark.parametrize("noise", ["load", "plant", "drift"])
@pytest.mark.parametrize(
    ("interpolation", "substeps", "start"),
    [
        ("linear", 1, {"x": "measured", "w": 0.1}),
        ("cubic", 1, {"x": {"lower": -1, "upper": 1}, "w": 0.1}),
        ("nearest", 3, {"x": 0.2, "w": {"lower": -1, "upper": 1}}),
    ],
)
def test_a_kalman_filter_of_a_recursion_equals_its_twin(
    noise: Any, interpolation: str, substeps: int, start: dict[str, Any]
) -> None:
    solver = {"interpolation": interpolation, "substeps": substeps}
    output = "x" if start["x"] == "measured" else "x + 0.1*w**2 + 0.1*x(k-2) + 0.1*x(k - L/h)"
    model = difference(RECURSION, output, solver=solver, initial=start)
    gaps = record(26)
    values = gaps.outputs[0].values.copy()
    values[[3, 4, 14]] = np.nan
    records = [record(20), with_output(gaps, values)]
    place = "y" if noise == "drift" else "u"
    sizes = {f"load[{place}]": (0.1, 10), f"tau[{place}]": (0.1, 1)}
    if noise == "plant":
        sizes = {"noise[x]": (0.1, 3), "noise[w]": (0.1, 3)}
    parameters = {n: {"lower": low, "upper": high} for n, (low, high) in sizes.items()}
    loss = Loss(noise_model=noise)
    problem = Problem.build(model, records, loss=loss, skip=2, parameters=parameters)
    theta = individuals(problem, 4)
    expected = np.array([plain_twins.predictions(problem, one) for one in theta])
    found = problem.predict(theta)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)
    costs = [plain_twins.fitness(problem, one) for one in theta]
    np.testing.assert_allclose(problem.evaluate_fitness(theta), costs, rtol=1e-7)
    kept = [i for i, name in enumerate(problem.free_names) if name not in parameters]
    white = Problem.build(model, records, skip=2).predict(theta[:, kept])
    assert np.all(np.max(np.abs(found - white), axis=1) > 0.001)
