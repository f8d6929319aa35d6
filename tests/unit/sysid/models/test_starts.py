"""One rule for the starts of all states takes the place of those of a document."""

from typing import Any

import pytest

from sysid.core.errors import InvalidSettings
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.models.starts import compares_starts, replace_starts

MOTOR: dict[str, Any] = {
    "name": "motor",
    "form": "differential",
    "inputs": {"u": "V"},
    "states": {"x": "rad", "v": "rad/s"},
    "parameters": {"K": {"lower": -10, "upper": 10}, "T": {"lower": 0.1, "upper": 9, "unit": "s"}},
    "equations": {"x": "v", "v": "(K*u - v)/T"},
    "outputs": {"y": "x"},
    "initial": {"x": {"lower": -1, "upper": 1}, "v": 3},
}
OPEN = {"lower": -10.0, "upper": 10.0, "bounds": "state"}


@pytest.mark.parametrize(
    ("initial", "starts"),
    [
        (None, {"x": {"lower": -1.0, "upper": 1.0}, "v": 3.0}),
        ("auto", {"x": {"lower": -1.0, "upper": 1.0}, "v": 3.0}),
        ("rest", {"x": {"lower": -1.0, "upper": 1.0}, "v": "0"}),
        ("free", {"x": {"lower": -1.0, "upper": 1.0}, "v": OPEN}),
        ("measured", {"x": "measured", "v": "measured"}),
    ],
)
def test_a_rule_takes_the_place_of_the_starts(initial: Any, starts: object) -> None:
    started = replace_starts(parse_model(MOTOR), initial)
    assert started.document["initial"] == starts
    assert replace_starts(started, initial).document == started.document
    assert parse_model(started.document).initial == started.initial


def test_all_states_that_a_rest_determines_are_steady() -> None:
    assert replace_starts(load_model("sopdt"), "rest").document["initial"] == {
        "w": "steady",
        "x": "steady",
    }


@pytest.mark.parametrize(
    ("model", "initial", "reason"),
    [
        ("mackey-glass", "rest", "x**n is not linear in the states"),
        ("exponential", "rest", "the equations change with k"),
        ("fopdt", "measured", "no output is a state by itself"),
    ],
)
def test_a_rule_without_meaning_is_refused(model: str, initial: Any, reason: str) -> None:
    with pytest.raises(InvalidSettings) as refusal:
        replace_starts(load_model(model), initial)
    assert refusal.value.pointer == "/initial"
    assert f"{initial!r} has no meaning for model {model!r}: {reason}. Use " in str(refusal.value)


def test_a_history_says_what_was_before_a_rest() -> None:
    document = {**MOTOR, "initial": {"v": 3}, "history": {"x": "t"}}
    with pytest.raises(InvalidSettings, match="/history says what 'x' did"):
        replace_starts(parse_model(document), "rest")


def test_a_document_leaves_its_starts_to_the_data() -> None:
    model = parse_model({**MOTOR, "initial": "auto"})
    assert model.document["initial"] == "auto"
    assert parse_model(model.document).initial == model.initial
    assert replace_starts(model, "free").document["initial"] == {"x": OPEN, "v": OPEN}
    assert compares_starts(model, None)
    assert not compares_starts(model, "rest")
    assert compares_starts(parse_model(MOTOR), "auto")
    assert not compares_starts(parse_model(MOTOR), None)
