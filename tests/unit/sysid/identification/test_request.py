"""The arguments of `identify` stand in one class. Its signature and its help have them all."""

import re
from inspect import getdoc, signature
from math import nan
from typing import Any, get_type_hints

import pytest

from sysid import identify
from sysid.core.errors import InvalidSettings
from sysid.core.settings import FitSettings, Loss
from sysid.identification.options import RunOptions
from sysid.identification.request import IdentificationRequest, accept_fields
from sysid.results.identification import Identification

RECORD = {"t": [0.0, 1.0, 2.0], "u": [0.0, 1.0, 1.0], "y": [0.0, 0.0, 1.0]}


def test_the_help_of_identify_has_every_argument_with_its_default() -> None:
    arguments = signature(identify).parameters
    fields = signature(IdentificationRequest).parameters
    assert list(arguments) == list(fields)
    assert [(one.kind, one.default) for one in arguments.values()] == [
        (one.kind, one.default) for one in fields.values()
    ]
    assert list(arguments)[:3] == ["model", "records", "settings"]
    assert arguments["seed"].default == 1
    text = (getdoc(identify) or "").partition("Parameters\n---")[2].partition("Returns\n---")[0]
    assert set(re.findall(r"^(\w+) : ", text, re.MULTILINE)) == set(arguments)


def test_a_call_with_a_wrong_argument_names_identify() -> None:
    with pytest.raises(TypeError, match=r"^identify\(\) got an unexpected keyword argument 'sed'"):
        identify("fopdt", RECORD, sed=2)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"^identify\(\) missing a required argument: 'model'"):
        identify()  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"^identify\(\) too many positional arguments"):
        identify("fopdt", RECORD, None, 1)  # type: ignore[call-arg, misc]


def test_a_class_whose_fields_a_function_accepts_stays_as_it_is() -> None:
    assert accept_fields(Loss)(lambda loss: loss.kind)("soft-l1") == "soft-l1"
    with pytest.raises(TypeError, match=r"^Loss.__init__\(\) got an unexpected"):
        Loss(bad=1)  # type: ignore[call-arg]


def test_the_types_of_identify_are_those_of_the_request() -> None:
    hints = get_type_hints(identify)
    fields = signature(IdentificationRequest).parameters
    answer = hints.pop("return")
    assert hints == {name: get_type_hints(IdentificationRequest)[name] for name in fields}
    assert answer is Identification
    assert signature(identify).parameters["records"].annotation == "Data | Sequence[Data]"
    assert hints["skip"] is int


def test_defaults_of_the_fit_are_those_of_its_settings() -> None:
    asked, fit = IdentificationRequest("fopdt", RECORD), FitSettings()
    assert (asked.prediction, asked.weights, asked.skip) == (fit.prediction, fit.weights, fit.skip)


@pytest.mark.parametrize(
    ("options", "fault"),
    [
        ({"seed": -1}, "/seed: found -1; need 0 or more, below 9223372036854775808"),
        ({"seed": 2**63}, "/seed: found 9223372036854775808; need 0 or more, below"),
        ({"validation_fraction": 1.0}, "/validation_fraction: found 1.0; need between 0 and 1"),
        ({"validation_fraction": nan}, "/validation_fraction: found nan; need between 0 and 1"),
    ],
)
def test_options_have_bounds(options: dict[str, Any], fault: str) -> None:
    with pytest.raises(InvalidSettings, match=f"^{fault}"):
        RunOptions(**options)
    with pytest.raises(InvalidSettings, match=f"^{fault}"):
        identify("fopdt", RECORD, **options)


@pytest.mark.parametrize("argument", ["seed", "skip", "posterior", "compare_orders"])
def test_none_does_not_leave_out_an_argument_with_a_default(argument: str) -> None:
    with pytest.raises(InvalidSettings, match=f"^/{argument}: found None; need"):
        identify("fopdt", RECORD, **{argument: None})


def test_none_leaves_out_an_argument_without_one() -> None:
    arguments = signature(identify).parameters.values()
    optional = {one.name: None for one in arguments if one.default is None}
    asked = IdentificationRequest("fopdt", RECORD, **optional)
    assert asked == IdentificationRequest("fopdt", RECORD)
    assert len(optional) >= 10
