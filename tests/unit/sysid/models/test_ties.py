"""Parameters tied to others: the same numbers as with the tie written into the equations."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from sysid.control.closed_loop import close_loop
from sysid.control.controllers import PidControl
from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.estimates import Estimate
from tests.support.library.search_problems import DUFFING, noisy
from tests.support.library.search_problems import record as duffing_record
from tests.support.library.small_models import (
    PARAMETERS,
    difference,
    differential,
    individuals,
    lag_element,
    record,
)

QUICK = GeneticAlgorithm(population=20, generations=60)


def test_a_tie_is_the_same_as_its_expression_in_the_equations() -> None:
    model = differential({"x": "(c*u(t - L) - b*x)/(1 + L)"}, "x", initial={"x": 0})
    plain = differential({"x": "((2*b + 1)*u(t - b/40) - b*x)/(1 + b/40)"}, "x", initial={"x": 0})
    changes = {"c": {"tied": "2*b + 1"}, "L": {"tied": "b/40"}}
    tied = Problem.build(model, [record()], parameters=changes)
    other = Problem.build(plain, [record()], parameters={"c": {"fixed": 0.5}, "L": {"fixed": 0.1}})
    assert [p.name for p in tied.free_parameters] == ["b"]
    theta = individuals(tied, 5)
    np.testing.assert_array_equal(tied.evaluate_fitness(theta), other.evaluate_fitness(theta))


def test_ties_of_ties_and_of_fixed_parameters_are_resolved() -> None:
    changes = {"c": {"tied": "2*L"}, "L": {"tied": "b/50"}, "b": {"fixed": 5.0}}
    parameters = {name: {"lower": 0, "upper": 9} for name in ("c", "L", "b", "a")}
    model = difference(
        {"x": "c*x(k-1) + L*u(k-1) + a"}, "x", parameters=parameters, initial={"x": 0}
    )
    problem = Problem.build(model, [record()], parameters=changes)
    plain = difference(
        {"x": "0.2*x(k-1) + 0.1*u(k-1) + a"},
        "x",
        parameters={"a": {"lower": 0, "upper": 1}},
        initial={"x": 0},
    )
    theta = np.array([[0.3]])
    np.testing.assert_allclose(
        problem.predict(theta), Problem.build(plain, [record()]).predict(theta), rtol=1e-13
    )


def test_a_tie_may_use_constants_and_intermediate_names() -> None:
    constants, let = {"two": 2}, {"double": "two*b", "state": "x"}
    model = lag_element(constants=constants, let=let)
    theta = individuals(Problem.build(model, [record()], parameters={"c": {"tied": "double"}}), 5)
    found, expected = (
        Problem.build(model, [record()], parameters={"c": {"tied": text}}).predict(theta)
        for text in ("double + 1", "2*b + 1")
    )
    np.testing.assert_array_equal(found, expected)
    with pytest.raises(InvalidSettings, match=r"column 5 of '2 \* state': this reads 'x'"):
        Problem.build(model, [record()], parameters={"c": {"tied": "2 * state"}})
    recursion = difference({"x": "0.5*x(k-1) + c"}, "x", let={"step": "b*h"})
    with pytest.raises(InvalidSettings, match="'step' changes with time or the sampling"):
        Problem.build(recursion, [record()], parameters={"c": {"tied": "step"}})
    bounds = PARAMETERS | {"c": {"lower": 0, "upper": 9, "tied": "double"}}
    plant = lag_element(constants=constants, let=let, parameters=bounds)
    loop = close_loop(plant, PidControl("u", "y", 0.5))
    assert {p.name: p.tied for p in loop.model.parameters}["c"] == "2*b"
    with pytest.raises(InvalidSettings, match="circular, b → b"):
        Problem.build(model, [record()], parameters={"b": {"tied": "double"}})


def by_name(estimates: tuple[Estimate, ...]) -> dict[str, Estimate]:
    return {estimate.name: estimate for estimate in estimates}


def test_a_tied_estimate_has_the_standard_error_of_its_expression() -> None:
    changes = {"a": {"tied": "b/5"}}
    problem = Problem.build(
        load_model("duffing-eq16"), [duffing_record(noisy())], parameters=changes
    )
    analysis = analyse_estimate(
        problem, np.array([DUFFING[p.name] for p in problem.free_parameters])
    )
    found = by_name(analysis.estimates)
    assert found["a"].status == "tied"
    assert found["a"].value == pytest.approx(found["b"].value / 5)
    assert found["b"].stderr is not None
    assert found["a"].stderr == pytest.approx(found["b"].stderr / 5)
    assert found["b"].interval95 is not None
    assert found["a"].interval95 == pytest.approx([end / 5 for end in found["b"].interval95])


def test_the_error_of_a_product_has_the_covariance_in_it() -> None:
    changes = {"a": {"tied": "c*b"}}
    problem = Problem.build(
        load_model("duffing-eq16"), [duffing_record(noisy())], parameters=changes
    )
    theta = np.array([DUFFING[p.name] for p in problem.free_parameters])
    analysis = analyse_estimate(problem, theta)
    assert analysis.uncertainty is not None
    names = [p.name for p in problem.free_parameters]
    slope = np.zeros(3)
    slope[names.index("c")], slope[names.index("b")] = DUFFING["b"], DUFFING["c"]
    expected = np.sqrt(slope @ analysis.uncertainty.covariance @ slope)
    assert by_name(analysis.estimates)["a"].stderr == pytest.approx(expected, rel=1e-5)


def test_a_tie_is_identified_and_validated_with_the_rest() -> None:
    found = identify(
        load_model("duffing-eq16"),
        duffing_record(noisy()),
        QUICK,
        parameters={"a": {"tied": "c*b"}},
        validation_fraction=0.3,
    )
    values = {estimate.name: estimate.value for estimate in found.parameters}
    assert values["a"] == pytest.approx(values["c"] * values["b"])
    assert values["a"] == pytest.approx(1.0, abs=0.2)
    assert found.rms_validation == pytest.approx(0.01, rel=0.3)


@pytest.mark.parametrize(
    ("changes", "pointer", "words"),
    [
        ({"b": {"tied": "2*b"}}, "/parameters/b/tied", "circular, b → b"),
        ({"b": {"tied": "c"}, "c": {"tied": "b+1"}}, "/parameters/c/tied", "circular, c → b → c"),
        (
            {"c": {"tied": "L"}, "L": {"tied": "b"}, "b": {"tied": "L+1"}},
            "/parameters/L/tied",
            "circular, L → b → L",
        ),
        ({"b": {"tied": "2*d"}}, "/parameters/b/tied", "'d' is not declared"),
        ({"b": {"tied": "2*"}}, "/parameters/b/tied", "column 3"),
        ({"b": {"tied": "x"}}, "/parameters/b/tied", "'x' is not declared"),
        ({"b": {"tied": "t"}}, "/parameters/b/tied", "changes with time"),
        ({"b": {"tied": 2.0}}, "/parameters/b/tied", "is not an expression"),
        ({"b": {"tied": "c", "lower": 0}}, "/parameters/b", "leave out 'lower'"),
        ({"q": {"tied": "c"}}, "/parameters/q", "no parameter 'q'"),
        ({"L": {"tied": "c - 1"}}, "/parameters", "as small as -3 s"),
    ],
)
def test_a_tie_that_cannot_be_used_is_refused(
    changes: Mapping[str, Any], pointer: str, words: str
) -> None:
    with pytest.raises(InvalidSettings) as caught:
        Problem.build(lag_element(), [record()], parameters=changes)
    assert caught.value.pointer == pointer
    assert words in caught.value.detail


def test_an_initial_state_cannot_be_tied() -> None:
    model = lag_element(initial={"x": {"lower": -1, "upper": 1}})
    with pytest.raises(InvalidSettings, match=r"/parameters/x\(0\)/tied: .*initial state"):
        Problem.build(model, [record()], parameters={"x(0)": {"tied": "c"}})


def test_a_lag_inside_its_bounds_by_its_tie_is_taken() -> None:
    changes = {"L": {"tied": "b/10"}}
    problem = Problem.build(lag_element(), [record()], parameters=changes)
    assert np.all(np.isfinite(problem.evaluate_fitness(individuals(problem, 5))))


def test_a_value_fixed_outside_its_bounds_needs_bounds_that_hold_it() -> None:
    with pytest.raises(InvalidSettings, match=r"/parameters/c/fixed: 3 lies outside .* \[-2, 2\]"):
        Problem.build(lag_element(), [record()], parameters={"c": {"fixed": 3}})
    changes = {"c": {"fixed": 3, "upper": 4}}
    problem = Problem.build(lag_element(), [record()], parameters=changes)
    assert [p.name for p in problem.free_parameters] == ["L", "b"]


def test_both_bounds_free_a_parameter_that_the_model_gives() -> None:
    given = {
        "c": {"lower": 0, "upper": 2, "fixed": 1},
        "L": {"lower": 0, "upper": 0.4},
        "b": {"lower": 0.1, "upper": 2},
    }
    model = lag_element(parameters=given)
    assert "c" not in {p.name for p in Problem.build(model, [record()]).free_parameters}
    freed = Problem.build(model, [record()], parameters={"c": {"lower": 0, "upper": 3}})
    assert "c" in {p.name for p in freed.free_parameters}
