"""What a message advises works when it is typed: settings, channels, starts and documents."""

import ast
import json
import math
import re
import shlex
from collections.abc import Iterator
from dataclasses import fields
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import typer

from lagid import Loss
from service.cli.common import apply_setting
from service.cli.identify_command import FIELD_ORIGINS
from service.cli.main import build_program
from service.core.bodies.user_documents import parse_yaml
from service.jobs.job_schemas import JobIn
from service.plants.tube import Tube
from sysid.core.text import SETTING, rewrite_settings
from sysid.data.holds import HOLDS
from sysid.data.records import Record
from sysid.identification.identify_arguments import write_setting
from sysid.models.catalogue.load import catalogue
from tests.support.library.defects import NOISES
from tests.support.library.judged_records import (
    FAST,
    FINE,
    NOISE,
    SLOW,
    draw_levels,
    draw_noise,
    draw_record,
    hold,
    make_record,
)
from tests.support.service.commands import run_lagid
from tests.support.source_facts import list_modules

OPEN = "…"
"""Stands in a text for what is known when it is written."""
VALUES: dict[tuple[str, str], list[tuple[str, ...]]] = {
    ("hold", OPEN): [("u", hold) for hold in HOLDS],
    ("loss", "scale"): [("scale", "0.3")],
    ("loss", "noise_model"): [("noise_model", kind) for kind in ("white", "load", "drift")],
    ("parameters", OPEN): [("upper", "0.5")],
    ("parameters", "physical"): [("physical", "lower")],
}
"""Field and name of a setting → names and values for what is open in it."""
NAMES = {"skip": ("8",), "initial": ("rest", "free")}
"""A setting without entries whose value is open in a text → values of it."""
OF_A_MODEL = {"history", "plant"}
"""Fields of the model's document that messages about this document write."""
QUICK = ("--set", "algorithm.generations=2")
BODY = {"model": "fopdt", "datasets": ["a"]}


def list_texts(path: Path) -> Iterator[str]:
    """List the texts that a module may print, with `OPEN` for what is put in."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    parts = {id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in node.values}
    silent = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if id(node) not in parts | silent and (text := read_text(node)):
            yield text


def read_text(node: ast.AST) -> str:
    if isinstance(node, ast.JoinedStr):
        return "".join(read_text(part) or OPEN for part in node.values)
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    return ""


@cache
def list_all_texts() -> list[str]:
    return [text for path in list_modules(("sysid", "service")) for text in list_texts(path)]


def fill(match: re.Match[str]) -> Iterator[str]:
    """Write the setting of a text with all values for what is open."""
    if match["name"]:
        yield match[0]
        return
    entries = [entry.split(": ") for entry in match["entries"].split(", ")]
    choices: list[list[tuple[str, ...]]] = [
        VALUES.get((match["field"], name), [(name, value)]) for name, value in entries
    ]
    for filled in product(*choices):
        setting = f"{{{', '.join(map(': '.join, filled))}}}"
        yield f"{match['field']}: {f'{{L: {setting}}}' if match['part'] else setting}"


def list_settings() -> list[str]:
    """List the settings of jobs that notes advise, as job files have them."""
    found = [match for text in list_all_texts() for match in SETTING.finditer(text)]
    own = [match for match in found if not match["field"] or match["field"] not in OF_A_MODEL]
    named = {
        f"{name}: {value}"
        for text in list_all_texts()
        for name, values in NAMES.items()
        if f"{name}: {OPEN}" in text
        for value in values
    }
    filled = {one for match in own if "\n" not in match.string for one in fill(match)}
    return sorted(filled | named)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A response with dead time to `heat`, beside a fan that does nothing."""
    path, x = tmp_path_factory.mktemp("data") / "two.csv", 0.0
    rows = ["t,fan,heat,temp"]
    for k in range(200):
        heat = int((k - 3) // 25 % 2 == 1)
        rows.append(f"{k},{int(k % 40 > 20)},{int(k // 25 % 2 == 1)},{x:.5f}")
        x += 0.1 * (2 * heat - x)
    path.write_text("\n".join(rows))
    return path


def identify(data: Path, *words: object, model: object = "fopdt") -> str:
    channels = ("--channels", "u=heat,y=temp")
    done = run_lagid("identify", data, "--model", model, *channels, *QUICK, *words)
    assert done.code == 0, done.stderr
    return done.stdout


def test_settings_are_found_where_they_are_written() -> None:
    some = {
        "hold: {u: zero}",
        "hold: {u: first}",
        "loss: {kind: soft-l1, scale: 0.3}",
        "prediction: one-step",
    }
    some |= {"skip: 8", "initial: free", "initial: rest"}
    some |= {"parameters: {L: {physical: lower}}"}
    assert some <= {*list_settings()}
    assert {"validation.fraction=0.3", "parameters.L.upper=0.5"} <= {*list_changes()}


def test_a_setting_in_a_note_works_in_a_job_file_a_command_and_a_notebook(data: Path) -> None:
    for setting in list_settings():
        given = parse_yaml(setting.encode())
        JobIn.model_validate({**BODY, **given})
        identify(data, *shlex.split(FIELD_ORIGINS.rewrite_note(setting)))
        arguments = eval(f"dict({rewrite_settings(setting, write_setting)})", {"Loss": Loss})
        assert [*arguments] == [*given]


def list_advice() -> list[str]:
    """List what findings advise to use, as job files have it."""
    texts = [text for path in list_modules(("sysid/judgement",)) for text in list_texts(path)]
    return [
        advice
        for text in texts
        for advice in re.findall(r"\b[Uu]se (\w+: (?:\{[^}]*\}|[^\s.,]+))", text)
    ]


def test_what_findings_advise_to_use_are_settings() -> None:
    assert len(list_advice()) > 3
    for advice in list_advice():
        filled = [advice.replace(OPEN, value) for value in NAMES.get(advice.partition(":")[0], "x")]
        for setting in filled:
            assert FIELD_ORIGINS.rewrite_note(setting).startswith("--"), setting


OUTLIERS = NOISES[0]


def _start_elsewhere(seed: int) -> Record:
    """A plant that is at rest with an input that the record does not have."""
    u = draw_levels(seed)
    y = FAST.respond(hold(u), u[0] + 0.5)[::FINE]
    return make_record(u, y + NOISE * draw_noise(seed))


DEFECTIVE: dict[str, tuple[Record, tuple[str, ...], str]] = {
    "outliers": (OUTLIERS.draw(FAST, 4), (), "--set loss.kind=soft-l1"),
    "a rest that is none": (_start_elsewhere(1), ("--set", "initial=rest"), "--set initial=free"),
    "an order": (draw_record(SLOW, 1), (), "the model sopdt"),
}
"""Name → a record, options of its first identification, what is advised."""


@pytest.mark.parametrize("name", DEFECTIVE)
def test_the_advice_of_a_finding_is_typed_and_taken(name: str, tmp_path: Path) -> None:
    record, options, expected = DEFECTIVE[name]
    (u,), (y,) = record.inputs, record.outputs
    path = tmp_path / "defect.csv"
    rows = zip(u.times.tolist(), u.values.tolist(), y.values.tolist(), strict=True)
    path.write_text("\n".join(["t,u,y", *(f"{t},{a:.6f},{b:.6f}" for t, a, b in rows)]))
    search = ("--set", "algorithm.generations=20")
    first = run_lagid("identify", path, "--model", "fopdt", *search, *options)
    assert first.code == 0, first.stderr
    printed = " ".join((first.stdout + first.stderr).split())
    assert expected in printed
    typed = re.findall(r"(?:--set \S+=\S+|--skip \d+|the model \w+)", printed)
    words = {
        word.rstrip(".,)") for word in typed if "noise_model" not in word and "hold" not in word
    }
    settings = [word.split() for word in words if word.startswith("--")]
    models = [word.split()[-1] for word in words if word.startswith("the model ")]
    model = next((one for one in models if one in catalogue()), "fopdt")
    taken = [part for setting in settings for part in setting]
    again = run_lagid("identify", path, "--model", model, *search, *taken)
    assert again.code == 0, again.stderr


def list_changes() -> list[str]:
    """List the values of ``--set`` that commands print."""
    found = {
        change
        for text in list_all_texts()
        for change in re.findall(r"(?<!lagid: )--set ([\w.]+=[\w.]*\w)", text)
    }
    return sorted(found)


def test_a_set_that_is_printed_is_one_of_a_job_or_a_plant() -> None:
    changes = list_changes()
    assert changes  # the pattern still finds what is printed
    for change in changes:
        if change.partition("=")[0] not in {field.name for field in fields(Tube)}:
            body: dict[str, object] = dict(BODY)
            apply_setting(body, change)
            JobIn.model_validate(body)


@pytest.mark.parametrize(
    "change", ["initial.x=0.25", "initial.x={lower: -1, upper: 1}", "initial.x.upper=9"]
)
def test_the_advice_about_a_start_can_be_typed(data: Path, change: str) -> None:
    done = run_lagid("identify", data, "--model", "fopdt", "--set", change)
    (advice,) = re.findall(r"--set '(.*?)'", done.stderr)
    identify(data, "--set", advice)
    word = run_lagid("identify", data, "--model", "fopdt", "--set", "initial.x=measured").stderr
    assert "the model's document, which lagid models show prints" in word


def test_a_start_that_a_built_in_model_measures_is_searched_by_a_setting_or_a_document(
    data: Path, tmp_path: Path
) -> None:
    words = ("--channels", "u=heat,y=temp", "--set", "initial.y={lower: -1, upper: 1}")
    refusal = run_lagid("identify", data, "--model", "tube", *words).stderr
    assert "If the model does not search it, add --set initial=free, or write it into" in refusal
    document = parse_yaml(run_lagid("models", "show", "tube").stdout.encode())
    document["initial"]["y"] = {"lower": -1, "upper": 1}
    model = tmp_path / "mine.json"
    model.write_text(json.dumps(document))
    for chosen in (("--model", model), ("--model", "tube", "--set", "initial=free")):
        done = run_lagid("identify", data, *chosen, *words[:2], *QUICK, "--json")
        assert "y(0)" in {one["name"] for one in json.loads(done.stdout)["parameters"]}


def test_the_channels_that_a_refusal_names_can_be_typed(data: Path) -> None:
    refusal = run_lagid("identify", data, "--model", "fopdt").stderr
    choices = re.findall(r"--channels (\S+)", refusal)
    assert choices == ["u=fan,y=temp", "u=heat,y=temp"]
    for channels in choices:
        done = run_lagid("identify", data, "--model", "fopdt", "--channels", channels, *QUICK)
        assert done.code == 0, done.stderr


def test_a_drift_in_the_model_s_document_is_estimated(data: Path, tmp_path: Path) -> None:
    document = parse_yaml(run_lagid("models", "show", "fopdt").stdout.encode())
    document["outputs"]["y"] += " + drift*t"
    document["parameters"]["drift"] = {"lower": -1, "upper": 1}
    model, drifting = tmp_path / "mine.json", tmp_path / "drifting.csv"
    model.write_text(json.dumps(document))
    head, *rows = data.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    lines = [f"{t},{fan},{heat},{float(y) + 0.01 * float(t):.5f}" for t, fan, heat, y in cells]
    drifting.write_text("\n".join([head, *lines]))
    found = json.loads(identify(drifting, "--json", model=model))
    (drift,) = [one["value"] for one in found["parameters"] if one["name"] == "drift"]
    assert math.isclose(drift, 0.01, rel_tol=0.02)


def list_commands() -> list[str]:
    """List the commands that messages name: in back-ticks, or at their end after a colon."""
    named = re.compile(r"`lagid ([a-z][^`]*)`|: lagid ([a-z]+(?: [^\s:]*[^\s:.])*)$")
    found = [match[1] or match[2] for text in list_all_texts() for match in named.finditer(text)]
    return sorted({command.replace(OPEN, "one") for command in found})


def test_a_command_in_a_message_is_one_with_such_words() -> None:
    assert len(list_commands()) > 15
    for line in list_commands():
        command: Any = typer.main.get_command(build_program())
        words = shlex.split(line)
        while hasattr(command, "commands") and words:
            context = command.make_context("lagid", list(words), resilient_parsing=True)
            _, command, words = command.resolve_command(context, words)
        if words:  # without words of its own, only its name is told
            command.make_context("lagid", words)
