"""The arguments of `identify` stand in one class. Its signature and its help have them all."""

import re
from inspect import getdoc, signature

import pytest

from sysid import identify
from sysid.core.errors import InvalidSettings
from sysid.identification.request import IdentificationRequest

RECORD = {"t": [0.0, 1.0, 2.0], "u": [0.0, 1.0, 1.0], "y": [0.0, 0.0, 1.0]}


def test_the_help_of_identify_has_every_argument_with_its_default() -> None:
    arguments = signature(identify).parameters
    assert arguments == signature(IdentificationRequest).parameters
    assert list(arguments)[:3] == ["model", "records", "settings"]
    assert arguments["seed"].default == 1
    text = (getdoc(identify) or "").partition("Parameters\n---")[2].partition("Returns\n---")[0]
    assert set(re.findall(r"^(\w+) : ", text, re.MULTILINE)) == set(arguments)


def test_a_call_with_a_wrong_argument_names_identify() -> None:
    with pytest.raises(TypeError, match=r"^identify\(\) got an unexpected keyword argument 'sed'"):
        identify("fopdt", RECORD, sed=2)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match=r"^identify\(\) missing 2 required"):
        identify()  # type: ignore[call-arg]


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
