"""What a model declares and does not use is found, wherever it could be used."""

from typing import Any

import pytest

from sysid.models.parse import parse_model
from sysid.models.unused import find_unused_names

DOCUMENT: dict[str, Any] = {
    "name": "spare",
    "form": "differential",
    "inputs": {"u": "V", "q": "V"},
    "states": {"x": "m"},
    "parameters": {name: {"lower": 0, "upper": 1} for name in "abcd"},
    "constants": {"m": 1, "n": 2},
    "let": {"gain": "a/m", "other": "gain*n"},
    "equations": {"x": "gain*u - x"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "/parameters/b /parameters/c /parameters/d /inputs/q /constants/n /let/other"),
        ({"outputs": {"y": "b*x + other"}}, "/parameters/c /parameters/d /inputs/q"),
        (
            {"initial": {"x": "b*c + d*q0 + n"}, "let": {"gain": "a/m"}},
            "",
        ),
        ({"equations": {"x": "other*q(t - d) - x"}}, "/parameters/b /parameters/c /inputs/u"),
    ],
)
def test_unused_declarations_have_their_places(changes: dict[str, Any], expected: str) -> None:
    found = find_unused_names(parse_model(DOCUMENT | changes))
    assert [fault.pointer for fault in found] == expected.split()


def test_fixed_parameters_and_those_of_ties_are_not_told() -> None:
    parameters = DOCUMENT["parameters"] | {
        "a": {"lower": 0, "upper": 9, "tied": "b*c + n"},
        "d": {"lower": 0, "upper": 1, "fixed": 0.5},
    }
    found = find_unused_names(parse_model(DOCUMENT | {"parameters": parameters}))
    assert [fault.pointer for fault in found] == ["/inputs/q", "/let/other"]


def test_the_lags_and_terms_of_a_polynomial_use_names() -> None:
    polynomial = {
        "name": "p",
        "form": "polynomial",
        "output": "y",
        "inputs": {"u": "V"},
        "degree": 1,
        "lags": {"y": [1], "u": ["late"]},
        "coefficients": {"lower": -1, "upper": 1},
        "parameters": {"d": {"lower": 0, "upper": 2}, "e": {"lower": 0, "upper": 2}},
        "constants": {"one": 1},
        "let": {"late": "one + d"},
    }
    assert [f.pointer for f in find_unused_names(parse_model(polynomial))] == ["/parameters/e"]
