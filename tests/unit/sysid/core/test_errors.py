"""Errors on their way from one process to another."""

import pickle

import pytest

from sysid.core.errors import (
    DivergedEverywhere,
    Fault,
    InvalidBounds,
    InvalidModel,
    InvalidRecord,
    InvalidSettings,
    MissingLibrary,
    NothingIdentifiable,
    RecordTooShort,
    SysidError,
    UnknownModel,
    UnknownParameter,
    UnreadableFile,
    UnreadableResult,
    UnwritableFile,
)

ERRORS: list[SysidError] = [
    DivergedEverywhere(20),
    InvalidBounds("L", 2.0, 1.0),
    InvalidModel([Fault("/equations/x", "an unknown name", 3)]),
    InvalidRecord("a channel is empty"),
    InvalidSettings("/skip", "need a whole number"),
    MissingLibrary("plot", "plotly"),
    NothingIdentifiable(["K", "L"]),
    RecordTooShort(3.0, 50.0, "the delay of 'u'"),
    UnknownModel("fopd", ["fopdt"]),
    UnknownParameter("M", ["K", "L"]),
    UnreadableFile("row 3 has a text", row=3, column="y"),
    UnreadableResult("result.json", "it is empty"),
    UnwritableFile("result.json", "the folder does not exist"),
]


def test_there_is_an_example_of_every_error() -> None:
    own = {kind for kind in SysidError.__subclasses__() if kind.__module__ == SysidError.__module__}
    assert {type(error) for error in ERRORS} >= own


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_an_error_of_another_process_is_the_same(error: SysidError) -> None:
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)
