"""Faults of a body are told at the option or in the file that the user wrote."""

import json
from typing import Any

import httpx
import pytest
import typer
from typer.testing import CliRunner

from service.cli import common, identify_command, sweep_command
from service.cli.common import (
    FieldOrigins,
    file_origins,
    print_error,
    print_json,
    print_line,
    print_table,
    report_faults,
)
from service.cli.main import build_program
from service.client.calls import NotFinite, ProblemError
from service.client.client import Client
from service.core.errors import FieldError

EVIL = "tube\x1b]0;root\x07\x9b2J\u202e\rgone"


def test_a_terminal_obeys_nothing_in_names_of_others(capsys: pytest.CaptureFixture[str]) -> None:
    print_line(f"job_1  {EVIL}")
    print_table(("id", "name"), [("job_1", f"{EVIL}\nforged")], empty="none")
    print_json({"name": EVIL})
    print_error(f"there is no job {EVIL}")
    printed = capsys.readouterr()
    shown = printed.out + printed.err
    assert all(sign == "\n" or sign.isprintable() for sign in shown)
    assert shown.count("\\u001b]0;root") == 4
    assert "\nforged" not in shown
    document = printed.out[printed.out.index("{") :]
    assert json.loads(document) == {"name": EVIL}


@pytest.mark.parametrize(
    ("pointer", "place"),
    [
        ("/sigma/2", "--sigma"),
        ("/relative", "--relative"),
        ("/truth/parameters/K", "--true K"),
        ("/truth/parameters", "--true"),
        ("/truth/inputs/u/expression", "--input u"),
        ("/truth/sample_time", "--sample-time"),
        ("/truth/samples", "--samples"),
        ("/datasets/0", "--data"),
        ("/channels/u", "--channels u"),
        ("/channels", "--channels"),
        ("/model", "--model"),
        ("/model/equations/x", "--model: /equations/x"),
        ("/algorithm/population", "--set algorithm.population"),
        ("/hold/a~1b", "--set hold.a/b"),
    ],
)
def test_a_pointer_is_told_as_the_option_that_gives_it(pointer: str, place: str) -> None:
    assert sweep_command.FIELD_ORIGINS.locate(pointer) == place


def test_every_field_that_an_option_gives_is_told_at_that_option() -> None:
    from service.sweeps.sweep_schemas import NoiseSweepIn

    by_options = {place.split("/")[1] for place in sweep_command.FIELD_ORIGINS.options}
    by_set = {
        "hold",
        "parameters",
        "prediction",
        "loss",
        "weights",
        "skip",
        "initial",
        "commands",
        "algorithm",
        "priority",
        "reuse",
        "keep_signals",
    }
    assert by_options | by_set == set(NoiseSweepIn.model_fields)


def test_a_pointer_into_a_file_follows_its_name() -> None:
    assert file_origins("job.yaml").locate("/seed") == "job.yaml: /seed"


def test_where_else_a_field_is_is_told_as_it_would_be_typed() -> None:
    fault = FieldError("/population", "unknown field; there is /algorithm/population")
    told = FieldOrigins().describe_faults([fault])
    assert told == "--set population: unknown field; there is --set algorithm.population"


def read_refusal(status: int, *entries: dict[str, Any]) -> ProblemError:
    return ProblemError(status, {"title": "refused", "errors": list(entries)})


def test_all_faults_are_one_line_with_columns_and_without_the_servers_words(
    capsys: pytest.CaptureFixture[str],
) -> None:
    entries = (
        {"pointer": "/sigma/0", "detail": "found -1"},
        {"pointer": "", "detail": "whole"},
        {"pointer": "/truth/inputs/u/expression", "column": 3, "detail": "ends"},
    )
    with pytest.raises(typer.Exit) as ended, report_faults(sweep_command.FIELD_ORIGINS):
        raise read_refusal(422, *entries)
    assert ended.value.exit_code == 1
    line = capsys.readouterr().err
    assert line == "lagid: --sigma: found -1; whole; --input u, column 3: ends\n"


@pytest.mark.parametrize(
    "error",
    [read_refusal(409, {"pointer": "/a", "detail": "b"}), read_refusal(422), read_refusal(404)],
)
def test_what_is_no_fault_of_the_body_goes_on_as_it_is(error: ProblemError) -> None:
    with pytest.raises(ProblemError) as told, report_faults(FieldOrigins()):
        raise error
    assert told.value is error


def test_a_number_that_is_none_is_wrong_usage_at_its_option(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(typer.Exit) as ended, report_faults(sweep_command.FIELD_ORIGINS):
        raise NotFinite("/truth/parameters/K", float("inf"))
    assert ended.value.exit_code == 2
    assert capsys.readouterr().err == "lagid: --true K: found inf; need a finite number\n"


WHITE = "If the noise is coloured, use loss: {noise_model: ar1}"
MODEL = "A reading without rounding needs the model solver: {interpolation: linear}"
HELD = "If the input was held, use hold: {u: zero}"


@pytest.mark.parametrize(
    ("places", "note", "end"),
    [
        (identify_command.FIELD_ORIGINS, WHITE, ", use --noise-model ar1"),
        (identify_command.FIELD_ORIGINS, HELD, ", use --set hold.u=zero"),
        (FieldOrigins(), WHITE, ", use --set loss.noise_model=ar1"),
        (identify_command.FIELD_ORIGINS, MODEL, "needs the model solver: {interpolation: linear}"),
        (FieldOrigins(), "a set {1: 2} of pairs: {a, b}", "a set {1: 2} of pairs: {a, b}"),
    ],
)
def test_a_note_names_the_option_that_can_be_typed(
    places: FieldOrigins, note: str, end: str
) -> None:
    assert places.rewrite_note(note).endswith(end)


def test_a_refused_export_is_told_at_its_option(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fault = {"pointer": "?format", "detail": "'control' is not possible: a**3"}
    answer = httpx.Response(422, json={"title": "refused", "errors": [fault]})
    client = Client(transport=httpx.MockTransport(lambda _: answer))
    monkeypatch.setattr(common, "connect_client", lambda *_: client)
    printed = CliRunner().invoke(build_program(), ["export", "run_1", "--format", "control"])
    assert printed.stderr == "lagid: --format: 'control' is not possible: a**3\n"
