"""docs/model.md: every field and function is there, and its example holds."""

import re

from sysid.language.functions import FUNCTIONS
from sysid.models.document_reader import parse_yaml
from sysid.models.model import NoisePlaces
from sysid.models.parse import parse_model
from tests.support.checkout import ROOT

PAGE = (ROOT / "docs/model.md").read_text(encoding="utf-8")
SOLVER = ("method", "step", "substeps", "history", "interpolation")
FIELDS = (
    "name",
    "title",
    "description",
    "source",
    "form",
    "inputs",
    "states",
    "parameters",
    "constants",
    "let",
    "equations",
    "outputs",
    "initial",
    "history",
    "noise",
)


def test_the_example_of_the_page_is_a_model() -> None:
    whole, growth, noise, part = re.findall(r"```yaml\n(.*?)```", PAGE, re.S)
    assert parse_model(parse_yaml(whole)).name == "valve-and-oven"
    assert parse_model(parse_yaml(growth)).find_history("x") is not None
    line = {
        "name": "line",
        "form": "differential",
        "inputs": {"u": "1"},
        "states": {"x": "1"},
        "equations": {"x": "u(t) - x"},
        "outputs": {"y": "x"},
    }
    assert parse_model(line | parse_yaml(noise)).noise == NoisePlaces(("x",), ("u",))
    names = ("k", "E", "V", "F", "tau", "H")
    rest = {
        "name": "reactor",
        "form": "differential",
        "inputs": {"c_in": "1", "T_in": "K"},
        "states": {"c": "1", "T": "K"},
        "parameters": {name: {"lower": 1, "upper": 2} for name in names},
        "outputs": {"y": "T"},
    }
    assert parse_model(rest | parse_yaml(part)).name == "reactor"


def test_every_field_of_a_model_is_on_the_page() -> None:
    rows = [row for row in PAGE.splitlines() if re.fullmatch(r"\|.*\|.*\|.+\|", row)]
    cells = "\n".join(row.rsplit("|", 3)[0] for row in rows)
    names = [*FIELDS, *(f"solver.{name}" for name in SOLVER)]
    assert [name for name in names if f"`{name}`" not in cells] == []


def test_every_function_of_the_language_is_on_the_page() -> None:
    [row] = re.findall(r"^\| functions \|(.*)\|$", PAGE, re.M)
    assert set(FUNCTIONS) - set(re.findall(r"\b\w+\b", row)) == set()
