"""A setting of the core, declared once: what a body, its schema and its way back make of it."""

import os
import subprocess
import sys
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal

import pytest
from pydantic import ValidationError

from service.core.bodies.derived_bodies import (
    derive_fields,
    read_settings,
    take_setting,
)
from service.core.bodies.descriptions import describe_fields
from service.core.bodies.wire import Body
from sysid.core.errors import InvalidSettings
from sysid.core.settings import (
    Bounds,
    FitSettings,
    GeneticAlgorithm,
    IslandChange,
    Loss,
    Migration,
    SequenceSearch,
    Stop,
)
from sysid.data.noise import Noise
from sysid.identification.options import RunOptions
from tests.support.checkout import ROOT


@dataclass(frozen=True)
class Cooling:
    """How it cools.

    Attributes
    ----------
    rate : float
        Share that is left, of ``start``.
    start : int or None
        RMS at which it starts. None: that of the
        first champion.

    Examples
    --------
    >>> 1
    1
    """

    rate: Annotated[float, Bounds(above=0, below=1)] = 0.5
    start: Annotated[int, Bounds(least=1, most=99)] | None = None


@dataclass(frozen=True)
class Search:
    """A search.

    Attributes
    ----------
    kind : {"slow", "fast"}
        Slow or fast.
    cooling : Cooling
        Settings of the cooling.
    steps : tuple of (int, float)
        Steps and their sizes.
    """

    kind: Literal["slow", "fast"] = "fast"
    cooling: Cooling = field(default_factory=Cooling)
    steps: tuple[tuple[int, float], ...] = ((0, 0.1),)


@derive_fields(Cooling, limits={"start": {"le": 9}})
class CoolingIn(Body):
    """How it cools."""


@derive_fields(Search, {Cooling: CoolingIn}, limits={"steps": {"max_length": 2}})
class SearchIn(Body):
    """A search."""

    kind_text: str = take_setting(Search, "kind")


def test_a_field_has_the_default_the_bounds_and_the_sentence_of_its_setting() -> None:
    fields = CoolingIn.model_json_schema()["properties"]
    rate, start = fields["rate"], fields["start"]
    assert rate == {
        "type": "number",
        "title": "Rate",
        "default": 0.5,
        "exclusiveMinimum": 0,
        "exclusiveMaximum": 1,
        "description": "share that is left, of `start`",
    }
    assert start["anyOf"] == [
        {"type": "integer", "minimum": 1, "maximum": 9},
        {"type": "null"},
    ]
    assert start["description"] == ("RMS at which it starts. null: that of the first champion")
    assert start["default"] is None


def test_a_setting_that_a_body_takes_alone_has_them_too() -> None:
    taken = SearchIn.model_fields["kind_text"]
    assert (taken.default, taken.description) == ("fast", "slow or fast")
    bounded = take_setting(FitSettings, "skip")
    assert [one.ge for one in bounded.metadata] == [0]


@pytest.mark.parametrize(
    "body",
    [
        {"kind": "other"},
        {"cooling": {"rate": 1}},
        {"cooling": {"start": 10}},
        {"cooling": {"unknown": 1}},
        {"steps": [[0, 1], [1, 2], [2, 3]]},
        {"steps": [[0, 1, 2]]},
    ],
)
def test_what_the_declaration_or_a_limit_forbids_is_refused(body: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        SearchIn.model_validate(body)


def dump_settings(body: Body) -> dict[str, Any]:
    return body.model_dump(mode="json", exclude={"kind_text"})


def test_a_body_is_read_back_as_the_settings_it_was_derived_from() -> None:
    assert read_settings(Search, dump_settings(SearchIn())) == Search()
    body = SearchIn.model_validate({"cooling": {"rate": 0.25, "start": 3}, "steps": [[4, 1]]})
    found = read_settings(Search, dump_settings(body))
    assert found == Search(cooling=Cooling(0.25, 3), steps=((4, 1.0),))
    assert isinstance(found.steps[0][1], float)


def test_whole_numbers_of_a_document_become_those_of_the_setting() -> None:
    """An axis of a sweep may write 1 for 1.0. Both are the same specification."""
    assert repr(read_settings(Stop, {"rms": 1})) == repr(Stop(rms=1.0))


@pytest.mark.parametrize(
    ("kind", "document", "fault"),
    [
        (Loss, {"knid": 1}, "/job/knid: unknown setting; did you mean 'kind'?"),
        (GeneticAlgorithm, {"stop": {"rsm": 1}}, "/job/stop/rsm: unknown setting"),
        (FitSettings, {"weights": [1, 2]}, r"/job/weights: found \[1, 2\]; need another kind"),
        (FitSettings, {"loss": 5}, "/job/loss: found 5; need an object"),
        (Search, {"steps": [[0, 0.1], [1]]}, r"/job/steps/1: found \[1\]; need another kind"),
        (Search, {"steps": [[0, 1, 2]]}, "/job/steps/0: found"),
    ],
)
def test_what_is_no_document_of_these_settings_is_refused_with_its_place(
    kind: type, document: dict[str, Any], fault: str
) -> None:
    with pytest.raises(InvalidSettings, match=f"^{fault}"):
        read_settings(kind, document, "/job")


def test_a_setting_without_a_default_is_needed() -> None:
    @dataclass(frozen=True)
    class Named:
        """A name.

        Attributes
        ----------
        name : str
            Its name.
        """

        name: str

    @derive_fields(Named)
    class NamedIn(Body):
        """A name."""

    assert NamedIn.model_fields["name"].is_required()
    assert NamedIn.model_json_schema()["required"] == ["name"]


def test_python_without_docstrings_has_bodies_without_descriptions() -> None:
    code = (
        "import service.api.app; from service.jobs.job_schemas import JobIn; "
        "print(JobIn.model_fields['skip'].description)"
    )
    done = subprocess.run(
        [sys.executable, "-OO", "-c", code],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.returncode) == ("None\n", 0), done.stderr


@pytest.mark.parametrize(
    "kind",
    [
        FitSettings,
        GeneticAlgorithm,
        IslandChange,
        Loss,
        Migration,
        Noise,
        RunOptions,
        SequenceSearch,
        Stop,
    ],
)
def test_every_setting_of_the_core_is_described(kind: type) -> None:
    assert list(describe_fields(kind)) == [one.name for one in fields(kind)]
