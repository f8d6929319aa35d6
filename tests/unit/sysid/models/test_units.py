"""Time constants in other units than seconds, which the equations read in seconds, are told."""

from typing import Any

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Stop
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import catalogue, load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.models.unit_checks import list_time_unit_warnings


def build_model(equation: str, unit: str, **fields: Any) -> Model:
    document = {
        "name": "first",
        "form": "differential",
        "inputs": {"u": "V"},
        "states": {"x": "V"},
        "parameters": {
            "T": {"lower": 0.01, "upper": 5, "unit": unit},
            "K": {"lower": 0.1, "upper": 5},
        },
        "equations": {"x": equation},
        "outputs": {"y": "x"},
        "initial": {"x": 0},
    }
    return parse_model(document | fields)


@pytest.mark.parametrize(
    "equation",
    ["(K*u - x)/T", "K*u/T - x/(60*T)", "(K*u - x)/(T + 1)", "K*u*exp(-T) - x", "(K*u - x)/-T"],
)
def test_a_time_constant_in_minutes_that_is_read_as_it_stands_is_told(equation: str) -> None:
    [note] = list_time_unit_warnings(build_model(equation, "min"))
    assert note.startswith("T has the unit min, but the equations read it unconverted")
    assert note.endswith("give it in s, or write 60*T.")
    assert list_time_unit_warnings(build_model(equation, "s")) == []
    assert list_time_unit_warnings(build_model(equation, "V")) == []


@pytest.mark.parametrize(
    "equation",
    [
        "(K*u - x)/(60*T)",
        "(K*u - x)/T/60",
        "(K*u - x)/(60*T + 1)",
        "K*u*exp(-60*T) - x",
        "(K*u - x)/(60*(T + 1))",
        "(K*u - x)/(60*(T + K*(T - 1)))",
    ],
)
def test_one_that_is_converted_is_not(equation: str) -> None:
    assert list_time_unit_warnings(build_model(equation, "min")) == []


@pytest.mark.parametrize(
    ("equation", "other", "told"),
    [
        ("K*u*tanh(T/S) - x", "min", []),
        ("K*u*tanh(T/S) - x", "s", ["T"]),
        ("K*u*tanh(T*S) - x", "min", ["T", "S"]),
        ("(K*u*T/S - x)/(T + S)", "min", ["T", "S"]),
        ("(K*u*T/S - x)/(60*(T + S))", "min", []),
    ],
)
def test_of_a_ratio_of_two_times_nothing_is_to_be_converted(
    equation: str, other: str, told: list[str]
) -> None:
    span = {"lower": 0.01, "upper": 5}
    both = {"T": span | {"unit": "min"}, "S": span | {"unit": other}, "K": span}
    notes = list_time_unit_warnings(build_model(equation, "min", parameters=both))
    assert [note.partition(" ")[0] for note in notes] == told


def test_a_recursion_may_count_in_what_it_likes() -> None:
    recursion = build_model("x(k-1)*T + K*u", "min", form="difference")
    assert list_time_unit_warnings(recursion) == []


def test_no_model_of_the_catalogue_is_told() -> None:
    assert [list_time_unit_warnings(load_model(name)) for name in catalogue()] == [[]] * len(
        catalogue()
    )


def test_a_result_tells_it() -> None:
    times = 0.1 * np.arange(60.0)
    u = Channel("u", times, np.sign(np.sin(times)), "V", hold="zero")
    y = Channel("y", times, np.sin(times - 0.5), "V")
    settings = GeneticAlgorithm(islands=1, stop=Stop(evaluations=200))
    found = identify(build_model("(K*u - x)/T", "ms"), Record((u,), (y,)), settings)
    assert any("write 0.001*T" in text for text in found.warnings)
