"""Bounds and values of parameters, and delays inside them, at their very ends."""

from math import inf
from typing import Any

import numpy as np
import pytest

from sysid.core.errors import InvalidBounds, InvalidSettings, RecordTooShort
from sysid.data.records import Channel, Record
from sysid.models.model import build_initial_parameters
from sysid.models.model_delays import (
    check_delays,
    check_record_length,
    compute_longest_delay,
    find_unused_settings,
    list_past_values,
)
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.ties import apply_ties, resolve_ties
from sysid.simulation.problem import Problem
from tests.support.library.small_models import difference, differential, lag_element


@pytest.mark.parametrize("value", [0.0, 0.25, 1.0])
def test_a_value_may_be_fixed_at_either_bound(value: float) -> None:
    assert Parameter("L", 0.0, 1.0, fixed=value).fixed == value
    free = (Parameter("L", 0.0, 1.0),)
    assert override_parameters(free, {"L": {"fixed": value}})[0].fixed == value


@pytest.mark.parametrize("value", [-1e-9, 1.0 + 1e-9])
def test_a_value_fixed_beyond_a_bound_is_refused(value: float) -> None:
    with pytest.raises(InvalidBounds, match="outside them"):
        Parameter("L", 0.0, 1.0, fixed=value)
    with pytest.raises(InvalidSettings, match="lies outside the bounds"):
        override_parameters((Parameter("L", 0.0, 1.0),), {"L": {"fixed": value}})


@pytest.mark.parametrize("change", [{"upper": inf}, {"lower": -inf}, {"lower": float("nan")}])
def test_a_bound_that_is_not_finite_is_refused_in_a_change_too(change: dict[str, float]) -> None:
    with pytest.raises(InvalidBounds, match="finite"):
        override_parameters((Parameter("K", 0.0, 1.0),), {"K": change})


def test_a_change_of_one_parameter_leaves_the_others_as_they_are() -> None:
    two = (Parameter("a", 0.0, 1.0, "V", "linear", 0.5), Parameter("b", 1.0, 10.0, scale="log"))
    changed = override_parameters(two, {"b": {"upper": 20.0}})
    assert changed == (two[0], Parameter("b", 1.0, 20.0, scale="log"))


def test_one_bound_frees_no_fixed_parameter_and_both_do() -> None:
    fixed = (Parameter("a", 0.0, 1.0, fixed=0.5),)
    assert override_parameters(fixed, {"a": {"upper": 2.0}})[0].fixed == 0.5
    assert override_parameters(fixed, {"a": {"lower": 0.0, "upper": 2.0}})[0].is_free


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, "both"),
        ({"lower": 0.1}, "upper"),
        ({"upper": 0.9}, "lower"),
        ({"lower": 0.1, "upper": 0.9}, None),
        ({"lower": 0.0, "upper": 1}, "both"),
        ({"lower": 0.1, "physical": "lower"}, "lower"),
        ({"physical": "upper"}, "upper"),
        ({"fixed": 0.5}, "both"),
    ],
)
def test_a_bound_that_is_changed_is_no_physical_limit_unless_it_is_said(
    change: dict[str, Any], expected: str | None
) -> None:
    (share,) = override_parameters((Parameter("s", 0.0, 1.0, physical="both"),), {"s": change})
    assert share.physical == expected


def test_a_bound_of_the_data_is_no_physical_limit_and_a_given_one_may_be() -> None:
    gain = (Parameter("K", -9.0, 9.0, bounds="gain"),)
    for side in ("lower", "upper", "both"):
        with pytest.raises(InvalidSettings, match="follows the data, so it is no physical limit"):
            override_parameters(gain, {"K": {"physical": side}})
    (lower,) = override_parameters(gain, {"K": {"lower": 0.0, "physical": "lower"}})
    assert (lower.lower, lower.physical) == (0.0, "lower")
    delay = (Parameter("L", 0.0, 9.0, bounds="delay"),)
    assert override_parameters(delay, {"L": {"physical": "lower"}})[0].is_physical("lower")
    with pytest.raises(InvalidSettings, match="'above' is not 'lower', 'upper' or 'both'"):
        override_parameters(delay, {"L": {"physical": "above"}})


def test_estimated_starts_are_one_parameter_for_each_experiment() -> None:
    bounds = {"lower": -1, "upper": 2}
    model = differential({"x": "v", "v": "-b*x"}, "x", initial={"x": bounds, "v": 0})
    assert [p.name for p in build_initial_parameters(model, 3)] == ["x(0)", "x(0)[2]", "x(0)[3]"]
    assert {(p.lower, p.upper, p.unit) for p in build_initial_parameters(model, 3)} == {
        (-1.0, 2.0, "m")
    }


def test_a_delay_as_long_as_the_record_is_refused_and_a_shorter_one_is_not() -> None:
    model = lag_element()
    [past] = [value for value in list_past_values(model) if value.delay is not None]
    for duration, is_refused in ((1.0, True), (1.001, False)):
        if is_refused:
            with pytest.raises(RecordTooShort, match="of L: below 1"):
                check_record_length(model, past, {"L": (0.0, 1.0)}, 0.1, duration)
        else:
            check_record_length(model, past, {"L": (0.0, 1.0)}, 0.1, duration)


def test_the_delay_of_a_recursion_is_in_seconds_with_its_whole_samples() -> None:
    model = difference({"x": "c*x(k-3 - L/h)"}, "x")
    [past] = [value for value in list_past_values(model) if value.delay is not None]
    assert compute_longest_delay(model, past, {"L": (0.0, 0.4)}, 0.1) == pytest.approx(0.7)


def test_a_delay_that_cannot_be_negative_is_causal_down_to_0() -> None:
    def make_parameters(lower: float) -> list[Parameter]:
        return [Parameter("L", lower, 1.0, "s"), Parameter("b", 0, 1), Parameter("c", 0, 1)]

    check_delays(lag_element(), make_parameters(0.0))
    with pytest.raises(InvalidSettings, match=r"u\(t - L\) can be as small as -0\.1 s"):
        check_delays(lag_element(), make_parameters(-0.1))


def test_a_parameter_that_only_an_output_reads_is_used() -> None:
    model = differential({"x": "-b*x"}, "x", outputs={"y": "c*x(t - L)"})
    assert find_unused_settings(model, model.parameters, None) == []
    unread = differential({"x": "-b*x"}, "x", outputs={"y": "c*x"})
    [fault] = find_unused_settings(unread, unread.parameters, None)
    assert fault.pointer == "/parameters/L"


def test_the_weight_of_the_only_output_is_unused_and_of_one_among_two_is_not() -> None:
    one = differential({"x": "u(t - L) - b*x"}, "c*x")
    two = differential({"x": "u(t - L) - b*x"}, "c*x", outputs={"y": "c*x", "z": "x"})
    [fault] = find_unused_settings(one, one.parameters, {"y": 2.0})
    assert fault.pointer == "/weights/y"
    assert find_unused_settings(two, two.parameters, {"y": 2.0}) == []


def test_a_tie_holds_in_outputs_and_in_delays_too() -> None:
    model = differential({"x": "u(t - L) - b*x"}, "x", outputs={"y": "c*x"})
    changes = {"c": {"tied": "2*b"}, "L": {"tied": "0.02*b"}}
    parameters = override_parameters(model.parameters, changes)
    tied = apply_ties(model, resolve_ties(model, parameters))
    plain = differential({"x": "u(t - 0.02*b) - b*x"}, "x", outputs={"y": "2*b*x"})
    assert (tied.equations, tied.outputs) == (plain.equations, plain.outputs)


def test_a_problem_takes_a_delay_that_is_fixed_at_its_lower_bound() -> None:
    times = 0.05 * np.arange(30)
    record = Record((Channel("u", times, times),), (Channel("y", times, np.sin(times)),))
    problem = Problem.build(lag_element(), [record], parameters={"L": {"fixed": 0.0}})
    assert [p.name for p in problem.free_parameters] == ["c", "b"]
