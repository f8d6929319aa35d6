"""Exported texts: numbers to their last bit, one identifier for each name."""

import inspect
import re
from typing import Any

import pytest

import sysid
from sysid.core.errors import InvalidSettings
from sysid.export.identifiers import Identifiers
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from tests.support.library.exported_programs import run_control

VALUES = {"K": 1 / 3, "T": 0.1 + 0.2, "L": 2**-0.5, "y0": 1e-300, "x(0)": -1 / 7}


def defaults_of(source: str) -> dict[str, Any]:
    """Default values of the exported Python function."""
    module: dict[str, Any] = {}
    exec(compile(source, "exported", "exec"), module)
    parameters = inspect.signature(module["simulate"]).parameters
    return {name: item.default for name, item in parameters.items() if item.default != item.empty}


def test_values_are_exported_to_their_last_bit() -> None:
    expected = [VALUES[name] for name in ("K", "T", "L", "y0", "x(0)")]
    python = sysid.export_model(load_model("fopdt"), VALUES, "python")
    assert list(defaults_of(python).values()) == expected
    c = sysid.export_model(load_model("fopdt"), VALUES, "c")
    assert [float(text) for text in re.findall(r"^    p\.\w+ = (.*);", c, re.M)] == expected
    script = run_control(sysid.export_model(load_model("fopdt"), VALUES, "control"))
    [(numerator, _)] = script["pairs"].values()
    assert numerator[0][0] == VALUES["L"]


def test_names_that_are_spelled_alike_stay_apart() -> None:
    names = Identifiers(["omega"])
    made = [names.make_identifier(name) for name in ("ω", "omega", "Ω", "ω", "2 a", "p_2 a", "²")]
    assert len(set(made)) == len(made)
    assert "omega" not in made
    assert all(name.isascii() and name.isidentifier() for name in made)
    bounds = {"lower": 0, "upper": 9}
    model = parse_model(
        {
            "name": "alike",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "V"},
            "parameters": {"ω": bounds, "omega": bounds},
            "equations": {"x": "u - ω*x + omega"},
            "outputs": {"y": "x"},
            "initial": {"x": 0},
        }
    )
    source = sysid.export_model(model, {"ω": 2.0, "omega": 3.0}, "python")
    values = defaults_of(source)
    assert sorted(values.values()) == [0.0, 2.0, 3.0]
    assert len({name for name in values if name.startswith("omega")}) == 2


@pytest.mark.parametrize("format", ["python", "c"])
def test_a_value_that_is_missing_is_no_zero(format: Any) -> None:
    values = {name: value for name, value in VALUES.items() if name != "x(0)"}
    with pytest.raises(InvalidSettings, match=r"x\(0\)"):
        sysid.export_model(load_model("fopdt"), values, format)


def test_a_delay_has_one_variable_however_often_it_is_read() -> None:
    document = dict(load_model("duffing-delay").document)
    source = sysid.export_model(
        parse_model(document), {"c": 0.2, "L": 0.5, "b": 5, "a": 1}, "python"
    )
    assert len(re.findall(r"^ +delay_\d+ = ", source, re.M)) == 1
