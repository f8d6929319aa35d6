"""Bounds of generic models follow the data, and give way to what is given."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.errors import InvalidBounds, InvalidModel
from sysid.core.types import FloatArray
from sysid.data.noise import Noise, add_output_noise
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import catalogue, copy_catalogue_document, load_model
from sysid.models.model import Model, build_initial_parameters
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem

PERIOD, N = 0.5, 200
TIMES = PERIOD * np.arange(N)
U = np.repeat(np.random.default_rng(1).uniform(40, 60, 10), 20)
GENERIC = ("foipdt", "fopdt", "ipdt", "sopdt", "topdt")


def make_record(gain: float = 3.0, offset: float = 100.0, u: FloatArray = U) -> Record:
    y = offset + gain * u
    return Record((Channel("u", TIMES, u),), (Channel("y", TIMES, y),))


def find_bounds(record: Record, **changes: dict[str, Any]) -> dict[str, Parameter]:
    problem = Problem.build(load_model("fopdt"), [record], parameters=changes)
    return {parameter.name: parameter for parameter in problem.all_parameters}


def list_parameters(model: Model) -> tuple[Parameter, ...]:
    return (*model.parameters, *build_initial_parameters(model, 1))


def is_inside(value: float, parameter: Parameter) -> bool:
    return parameter.lower < value < parameter.upper


@pytest.mark.parametrize("gain", [1e-6, -3.0, 1e6])
@pytest.mark.parametrize("offset", [-1e3, 0.0, 20.0])
def test_bounds_contain_the_plant_in_any_units(gain: float, offset: float) -> None:
    found = find_bounds(make_record(gain, offset))
    assert is_inside(gain, found["K"])
    assert is_inside(offset, found["y0"])
    assert is_inside(gain * U[0], found["x(0)"])
    assert found["K"].upper < 200 * abs(gain)


@pytest.mark.parametrize(
    ("model", "u", "y", "units"),
    [
        ("fopdt", "%", "°C", {"K": "°C/%", "T": "s", "L": "s", "y0": "°C", "x(0)": "°C"}),
        ("sopdt", "N·s", "l/min", {"K": "(l/min)/(N·s)", "r": "1", "x(0)": "l/min"}),
        ("ipdt", "%", "m", {"K": "m/(%·s)", "y(0)": "m"}),
        ("ipdt", "V", "V", {"K": "1/s"}),
        ("fopdt", "V", "V", {"K": "1", "y0": "V"}),
        ("fopdt", "1", "°C", {"K": "1", "y0": "°C"}),
        ("fopdt", "%", "1", {"K": "1", "y0": "1"}),
    ],
)
def test_generic_parameters_have_the_units_of_the_channels(
    model: str, u: str, y: str, units: dict[str, str]
) -> None:
    plain = make_record()
    sides = ((plain.inputs, u), (plain.outputs, y))
    record = Record(*(tuple(replace(c, unit=unit) for c in side) for side, unit in sides))
    for records in ([record], [plain, record]):  # a record without units says nothing
        problem = Problem.build(load_model(model), records)
        parameters = {parameter.name: parameter.unit for parameter in problem.all_parameters}
        assert parameters == parameters | units


def test_a_declared_unit_is_kept() -> None:
    document = copy_catalogue_document("fopdt")
    document["parameters"]["K"]["unit"] = "K/%"
    del document["parameters"]["y0"]["bounds"]
    record = Record((Channel("u", TIMES, U, unit="%"),), (Channel("y", TIMES, 2.0 * U, unit="°C"),))
    problem = Problem.build(load_model(document), [record])
    units = {parameter.name: parameter.unit for parameter in problem.all_parameters}
    assert (units["K"], units["y0"]) == ("K/%", "1")


def test_times_follow_period_and_duration() -> None:
    found, duration = find_bounds(make_record()), float(TIMES[-1])
    assert (found["L"].lower, found["L"].upper) == (0.0, duration / 2)
    assert found["T"].lower < PERIOD
    assert found["T"].upper > duration
    slower = Record(
        *(
            tuple(replace(c, times=60 * c.times) for c in part)
            for part in (make_record().inputs, make_record().outputs)
        )
    )
    assert find_bounds(slower)["T"].upper == pytest.approx(60 * found["T"].upper)
    assert find_bounds(slower)["T"].lower == pytest.approx(60 * found["T"].lower)


def test_the_shortest_record_limits_the_dead_time() -> None:
    short = Record(
        *(
            tuple(replace(c, times=c.times[:50], values=c.values[:50]) for c in part)
            for part in (make_record().inputs, make_record().outputs)
        )
    )
    problem = Problem.build(load_model("fopdt"), [make_record(), short])
    assert {p.name: p for p in problem.all_parameters}["L"].upper == short.stop / 2


def test_an_integral_gain_follows_the_area_of_the_input() -> None:
    u = np.where(TIMES < 10, 1.0, -1.0) * 7.0
    y = 1e-3 * np.concatenate([[0.0], np.cumsum(u[:-1]) * PERIOD])
    problem = Problem.build(load_model("ipdt"), [make_record(u=u)], skip=0)
    level = Record((Channel("u", TIMES, u),), (Channel("y", TIMES, y),))
    gain = Problem.build(load_model("ipdt"), [level]).all_parameters[0]
    assert is_inside(1e-3, gain)
    assert gain.upper < 3e-2
    assert problem.all_parameters[0].upper > gain.upper


def test_given_bounds_are_kept_one_by_one() -> None:
    automatic = find_bounds(make_record())
    found = find_bounds(make_record(), K={"upper": 4.0}, L={"lower": 1.0}, y0={"fixed": 7.0})
    assert found["K"].upper == 4.0
    assert found["K"].lower == automatic["K"].lower
    assert (found["L"].lower, found["L"].upper) == (1.0, automatic["L"].upper)
    assert found["y0"].fixed == 7.0
    assert found["T"] == automatic["T"]


@pytest.mark.parametrize(
    "change",
    [{"lower": 1e9}, {"upper": -1e9}, {"fixed": 1e9}, {"lower": 1e9, "upper": 2e9}],
)
def test_a_given_value_beyond_the_data_moves_the_other_bound(change: dict[str, float]) -> None:
    found = find_bounds(make_record(), K=change)["K"]
    assert found.lower < found.upper
    assert all(getattr(found, name) == value for name, value in change.items())


def test_a_given_upper_bound_of_a_logarithmic_scale_keeps_the_lower_one_positive() -> None:
    found = find_bounds(make_record(), T={"upper": 1e-6})["T"]
    assert 0 < found.lower < found.upper == 1e-6


def test_a_model_with_numbers_keeps_its_other_faults() -> None:
    with pytest.raises(ValueError, match=r"\[9, 1\]"):
        override_parameters(load_model("tube").parameters, {"L": {"lower": 9.0}})


def test_a_given_upper_bound_of_a_delay_does_not_make_it_negative() -> None:
    with pytest.raises(InvalidBounds, match=r"\[0, -1\]"):
        find_bounds(make_record(), L={"upper": -1.0})


def test_a_fast_input_may_belong_to_a_slow_process() -> None:
    fast = np.random.default_rng(2).standard_normal(N)
    y = np.zeros(N)
    for k in range(1, N):
        y[k] = 0.95 * y[k - 1] + 0.05 * 3.0 * fast[k - 1]
    record = Record((Channel("u", TIMES, fast),), (Channel("y", TIMES, y),))
    assert 10 * np.ptp(y) / np.ptp(fast) < 6.0  # ten ratios are close
    assert find_bounds(record)["K"].upper > 10 * 3.0


@pytest.mark.parametrize("part", ["input", "output"])
def test_data_that_say_nothing_leave_the_documents_bounds(part: str) -> None:
    flat = np.full(N, 3.0)
    record = make_record(u=flat)
    if part == "output":
        record = Record((Channel("u", TIMES, U),), (Channel("y", TIMES, flat),))
    gain = load_model("fopdt").parameters[0]
    assert find_bounds(record)["K"] == gain


def test_bounds_of_other_outputs_are_those_of_a_new_problem() -> None:
    """Runs that differ in their noise share a problem."""
    noisy = [add_output_noise(make_record(), Noise(5.0, seed), 0) for seed in (1, 2)]
    model = load_model("fopdt")
    shared = Problem.build(model, [noisy[0]]).replace_outputs([noisy[1]])
    assert shared.all_parameters == Problem.build(model, [noisy[1]]).all_parameters
    assert shared.all_parameters != Problem.build(model, [noisy[0]]).all_parameters


def test_only_generic_models_of_the_catalogue_follow_the_data() -> None:
    following = {
        name
        for name in catalogue()
        if any(parameter.bounds for parameter in load_model(name).parameters)
    }
    assert following == set(GENERIC)


@pytest.mark.parametrize("name", GENERIC)
def test_the_rules_are_part_of_the_document(name: str) -> None:
    model = load_model(name)
    assert parse_model(model.document) == model
    assert model.document["parameters"]["L"]["bounds"] == "delay"


@pytest.mark.parametrize(
    ("change", "pointer", "told"),
    [
        ({"K": {"lower": 0, "upper": 1, "bounds": "gian"}}, "/parameters/K/bounds", "gain"),
        ({"K": {"lower": 0, "upper": 1, "bounds": 3}}, "/parameters/K/bounds", "gain"),
    ],
)
def test_an_unknown_rule_is_refused(change: dict[str, Any], pointer: str, told: str) -> None:
    document = copy_catalogue_document("fopdt")
    with pytest.raises(InvalidModel) as refusal:
        parse_model({**document, "parameters": {**document["parameters"], **change}})
    (fault,) = refusal.value.faults
    assert fault.pointer == pointer
    assert told in fault.detail


def test_a_recursion_has_no_bounds_of_a_plant() -> None:
    document = {
        "name": "recursion",
        "form": "difference",
        "states": {"y": "1"},
        "parameters": {"a": {"lower": 0, "upper": 1, "bounds": "gain"}},
        "equations": {"y": "a*y(k-1)"},
        "outputs": {"y": "y"},
        "initial": {"y": {"lower": 0, "upper": 1, "bounds": "offset"}},
    }
    with pytest.raises(InvalidModel) as refusal:
        parse_model(document)
    places = [fault.pointer for fault in refusal.value.faults]
    assert places == ["/parameters/a/bounds", "/initial/y/bounds"]
