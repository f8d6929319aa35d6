"""Which bounds to widen: advice that holds for all parameters together, and is possible."""

from typing import Any

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identifiability.active_bounds import (
    ActiveBound,
    find_holding_bounds,
    is_active,
    rank_active_bounds,
)
from sysid.identifiability.bound_limits import find_widest_bounds
from sysid.judgement.holding_bounds import find_cause_in_bounds
from sysid.models.model import Model
from sysid.models.parameters import Parameter
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from sysid.uncertainty.analysis import analyse_estimate
from tests.support.library.polynomials import TRUTH, document, record_of

TIMES = 0.05 * np.arange(400.0)
ANYWHERE = (-np.inf, np.inf)
U = Channel("u", TIMES, np.where((TIMES // 3) % 2 < 1, 0.0, 1.0), hold="zero")
A, B, C = np.random.default_rng(5).standard_normal((3, 500))


def space(number: int) -> tuple[Parameter, ...]:
    return tuple(Parameter(name, 0.0, 1.0) for name in "abcd"[:number])


def find_advice(
    columns: FloatArray, truth: FloatArray, place: FloatArray, reaches: Any = None
) -> tuple[tuple[ActiveBound, ...], list[str]]:
    """Advice at the best place inside the bounds for data of a linear model, and who is pulled."""
    one = space(place.size)
    influence = columns @ (place - truth) + 1e-3 * C
    found = rank_active_bounds(one, reaches or (ANYWHERE,) * place.size, influence, columns, place)
    alone = is_active(influence, columns, place)
    return found, [p.name for p, is_out in zip(one, alone, strict=True) if is_out]


def test_a_bound_that_only_stands_in_for_another_is_not_to_be_widened() -> None:
    """b lies at its upper bound because a is held: once a is free, b belongs inside."""
    columns = np.column_stack([A, 0.9 * A + 0.4 * B])
    found, alone = find_advice(columns, np.array([3.0, 0.5]), np.array([1.0, 1.0]))
    assert alone == ["a", "b"]
    assert [(one.name, one.side) for one in found] == [("a", "upper")]


def test_of_two_with_one_effect_one_is_widened() -> None:
    columns = np.column_stack([A, A])
    found, alone = find_advice(columns, np.array([2.0, 2.0]), np.array([1.0, 1.0]))
    assert alone == ["a", "b"]
    assert [one.name for one in found] == ["a"]


def test_bounds_that_hold_back_both_are_both_told_the_costliest_first() -> None:
    columns = np.column_stack([A, B])
    found, _ = find_advice(columns, np.array([-1.0, 4.0]), np.array([0.0, 1.0]))
    assert [(one.name, one.side) for one in found] == [("b", "upper"), ("a", "lower")]
    assert found[0].share + found[1].share == pytest.approx(1.0, abs=1e-4)


def test_what_cannot_move_outwards_leaves_it_to_those_that_can() -> None:
    """a is wanted below what is possible: b, of nearly the same effect, takes its part."""
    columns = np.column_stack([A, A + 0.3 * B])
    reaches = ((0.0, np.inf), ANYWHERE)
    found, alone = find_advice(columns, np.array([-2.0, -1.0]), np.array([0.0, 0.0]), reaches)
    assert alone == ["a", "b"]
    assert [one.name for one in found] == ["b"]


def test_the_step_goes_no_farther_than_is_possible() -> None:
    columns = np.column_stack([A, B])
    reaches = ((-0.5, 2.0), ANYWHERE)
    [only], _ = find_advice(columns, np.array([-4.0, 0.5]), np.array([0.0, 0.5]), reaches)
    assert (only.name, only.limit) == ("a", -0.5)
    assert only.share == pytest.approx(1 - (3.5 / 4) ** 2, abs=0.01)
    assert only.advice == "lower the bound of a, to -0.5 at the least"


def build_lag(**bounds: Any) -> Model:
    """First-order lag behind a dead time."""
    parameters = {
        "K": {"lower": 0.1, "upper": 5},
        "T": {"lower": 0.1, "upper": 2, "unit": "s"},
        "L": {"lower": 0, "upper": 1, "unit": "s"},
    }
    return parse_model(
        {
            "name": "lag",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "m"},
            "parameters": {
                name: {**one, **bounds.get(name, {})} for name, one in parameters.items()
            },
            "equations": {"x": "(K*u(t-L) - x)/T"},
            "outputs": {"y": "x"},
            "initial": {"x": 0},
        }
    )


def build_problem(model: Model, ahead: float = 0.0, **truth: float) -> Problem:
    """Data of a lag; `ahead`: the output is recorded so much too early."""
    values = {"K": 2.0, "T": 0.6, "L": 0.3} | truth
    y = simulate(model, [U], values, times=TIMES).channel("y").values
    noise = np.random.default_rng(1).normal(0, 0.01, y.size)
    shifted = np.interp(TIMES + ahead, TIMES, y) + noise
    return Problem.build(model, [Record((U,), (Channel("y", TIMES, shifted, "m"),))])


def test_a_lag_at_zero_is_not_to_be_negative() -> None:
    found = analyse_estimate(
        build_problem(build_lag(), ahead=0.25, L=0.0, T=1.0), np.array([2.0, 1.0, 0.0])
    )
    assert found.estimates[2].status == "at bound"
    assert "L" not in [one.name for one in found.active_bounds]


def test_a_lag_that_is_held_above_zero_may_go_down_to_it() -> None:
    model = build_lag(L={"lower": 0.5, "upper": 1.0})
    found = analyse_estimate(build_problem(model, L=0.1), np.array([2.0, 0.6, 0.5]))
    [only] = [one for one in found.active_bounds if one.name == "L"]
    assert (only.side, only.limit) == ("lower", 0.0)
    assert only.advice == "lower the bound of L, to 0 s at the least"


def test_a_time_constant_is_not_to_be_negative_nor_zero_to_be_passed() -> None:
    changed = build_problem(build_lag(T={"lower": 0.5}))
    assert find_widest_bounds(changed, changed.free_parameters[1]) == (0.0, np.inf)
    logarithmic = build_problem(build_lag(K={"scale": "log"}))
    assert find_widest_bounds(logarithmic, logarithmic.free_parameters[0]) == (0.0, np.inf)
    assert find_widest_bounds(changed, changed.free_parameters[0]) == (-np.inf, np.inf)


def test_a_lag_is_not_to_reach_as_far_back_as_the_record() -> None:
    short = build_problem(build_lag())
    low, high = find_widest_bounds(short, short.free_parameters[2])
    assert low == 0.0
    assert high == pytest.approx(TIMES[-1], rel=1e-6)


def test_of_two_lags_in_a_row_each_may_take_what_the_other_leaves() -> None:
    parameters = {"a": {"lower": 0.2, "upper": 1}, "b": {"lower": -0.1, "upper": 1}}
    model = parse_model(
        {
            "name": "two",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "m"},
            "parameters": parameters,
            "equations": {"x": "u(t-a-b) - x"},
            "outputs": {"y": "x"},
            "initial": {"x": 0},
        }
    )
    made = Problem.build(model, [Record((U,), (Channel("y", TIMES, np.sin(TIMES), "m"),))])
    first, second = (find_widest_bounds(made, one) for one in made.free_parameters)
    assert first[0] == pytest.approx(0.1, abs=1e-6)
    assert second[0] == pytest.approx(-0.2, abs=1e-6)


@pytest.mark.parametrize(
    ("equation", "span", "expected"),
    [
        ("(u - x)/c**2", (-2.0, -1.0), (-np.inf, 0.0)),
        ("(u - x)*c**-2", (1.0, 2.0), (0.0, np.inf)),
        ("u - c**0.5*x", (1.0, 2.0), (0.0, np.inf)),
        ("u - c**3*x", (1.0, 2.0), ANYWHERE),
    ],
)
def test_a_base_keeps_its_sign_where_its_power_needs_one(
    equation: str, span: tuple[float, float], expected: tuple[float, float]
) -> None:
    model = parse_model(
        {
            "name": "power",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "V"},
            "parameters": {"c": {"lower": span[0], "upper": span[1]}},
            "equations": {"x": equation},
            "outputs": {"y": "x"},
            "initial": {"x": 0},
        }
    )
    problem = Problem.build(model, [Record((U,), (Channel("y", TIMES, np.sin(TIMES), "V"),))])
    assert find_widest_bounds(problem, problem.free_parameters[0]) == expected


def find_holding(columns: FloatArray, truth: FloatArray, place: FloatArray) -> list[str]:
    noise = np.random.default_rng(8).standard_normal(columns.shape[0])
    influence = columns @ (place - truth) + noise
    limits = (ANYWHERE,) * place.size
    found = find_holding_bounds(space(place.size), limits, influence, columns, place)
    return [f"{one.name} {one.side}" for one in found]


def test_a_bound_that_costs_little_still_holds_a_search_if_the_data_show_it() -> None:
    rng = np.random.default_rng(2)
    columns = rng.standard_normal((20_000, 2))
    place, truth = np.array([1.0, 0.5]), np.array([1.15, 0.5])  # 2 % of the squared error
    assert find_holding(columns, truth, place) == ["a upper"]
    assert find_holding(columns[:200], truth, place) == []  # here it may be chance
    influence = columns @ (place - truth) + rng.standard_normal(20_000)
    assert rank_active_bounds(space(2), (ANYWHERE,) * 2, influence, columns, place) == ()


@pytest.mark.parametrize("seed", range(10))
def test_a_bound_at_the_true_value_holds_nothing(seed: int) -> None:
    columns = np.random.default_rng(seed).standard_normal((1000, 2))
    assert find_holding(columns, np.array([1.0, 0.5]), np.array([1.0, 0.5])) == []


def test_neighbouring_residuals_that_are_alike_tell_less() -> None:
    rng = np.random.default_rng(3)
    slow = np.convolve(rng.standard_normal(2099), np.ones(100) / 10, "valid")
    columns = np.convolve(rng.standard_normal(2099), np.ones(100) / 10, "valid")[:, None]
    influence = slow - 0.15 * columns[:, 0]
    assert find_holding_bounds(space(1), (ANYWHERE,), influence, columns, np.array([1.0])) == ()
    shuffled = rng.permutation(2000)
    found = find_holding_bounds(
        space(1), (ANYWHERE,), influence[shuffled], columns[shuffled], np.array([1.0])
    )
    assert [one.name for one in found] == ["a"]


def test_the_bounds_of_a_polynomial_are_told_as_the_cause() -> None:
    record = record_of(TRUTH, noise=0.01)
    changes = {"a[y(k-1)]": {"upper": 0.5}}
    held = Problem.build(parse_model(document(list(TRUTH))), [record], parameters=changes)
    values = {f"a[{term}]": value for term, value in TRUTH.items()} | {"a[y(k-1)]": 0.5}
    theta = np.array([values[one.name] for one in held.free_parameters])
    [only] = find_cause_in_bounds(held, theta, analyse_estimate(held, theta))
    assert (only.name, only.side, only.bound) == ("a[y(k-1)]", "upper", 0.5)
    limit = {"physical": "upper"}
    marked = Problem.build(
        held.given_model, [record], parameters={"a[y(k-1)]": {"upper": 0.5, **limit}}
    )
    assert find_cause_in_bounds(marked, theta, analyse_estimate(marked, theta)) == ()
    free = Problem.build(parse_model(document(list(TRUTH))), [record])
    inside = theta.copy()
    assert find_cause_in_bounds(free, inside, analyse_estimate(free, inside)) == ()
