"""Benchmark programs tell their figures as JSON and Markdown and end as the contract says."""

import json
import sys
from importlib import import_module
from pathlib import Path

import pytest

from benchmarks import collect, dependencies, night, real_data
from benchmarks.real_data import all as every
from benchmarks.table import Row, Skipped, parser, report

HOLDS, MISSES = Row("quick", 1.0, "s", 2.0), Row("slow", 3.0, "s", 2.0)
SHOWN, SKIPPED = Row("shown", 9.0, "ms"), Skipped("peer", "not installed")


def end_program(rows, skipped, *options):
    """The exit code of a program that found these figures."""
    try:
        report("Title", rows, skipped, parser("a program").parse_args(options))
    except SystemExit as end:
        return end.code
    return 0


@pytest.mark.parametrize(
    ("rows", "skipped", "code"),
    [([HOLDS, SHOWN], [], 0), ([HOLDS, MISSES], [SKIPPED], 1), ([HOLDS], [SKIPPED], 2)],
)
def test_a_check_tells_misses_then_what_was_skipped(rows, skipped, code):
    assert end_program(rows, skipped, "--check") == code
    assert end_program(rows, skipped) == 0


def test_figures_with_bars_are_written_as_json_and_all_as_markdown(tmp_path):
    file = tmp_path / "one.json"
    end_program([SHOWN, MISSES], [SKIPPED], "--json", str(file))
    assert json.loads(file.read_text()) == [
        {"name": "slow", "value": 3.0, "unit": "s", "bar": 2.0, "relation": "<=", "holds": False}
    ]
    lines = (tmp_path / "one.md").read_text().splitlines()
    assert [line.split(" | ")[0] for line in lines[4:]] == ["| slow", "| shown", "| peer"]


def test_the_table_of_all_names_each_program_and_those_that_wrote_nothing(tmp_path, monkeypatch):
    end_program([HOLDS], [], "--json", str(tmp_path / "one.json"))
    monkeypatch.setattr(sys, "argv", ["collect", str(tmp_path), "one", "two"])
    assert collect.main() == 1
    text = (tmp_path / "bench.md").read_text()
    assert "| one: quick | 1 | s | <= 2 | yes |" in text
    assert "| two | did not finish |" in text
    assert json.loads((tmp_path / "bench.json").read_text())[0]["name"] == "one: quick"


def test_every_program_on_measured_records_is_part_of_all_of_them() -> None:
    folder = Path(real_data.__path__[0])
    programs = [import_module(f"{real_data.__name__}.{one.stem}") for one in folder.glob("*.py")]
    own = {one.measure for one in programs if hasattr(one, "measure")} - {every.measure}
    assert own == set(every.PROGRAMS.values())


def test_the_night_says_what_a_program_could_not_measure(tmp_path):
    file = tmp_path / "one.json"
    end_program(
        [HOLDS], [Skipped("known vulnerabilities", "not reached: no answer")], "--json", str(file)
    )
    summary, misses = night.summarize(night.Part(["--json", str(file)]), tmp_path / "one.log")
    assert misses == 0
    assert summary == ("1 of 1 bars hold. Skipped: known vulnerabilities (not reached: no answer)")


@pytest.mark.parametrize(
    ("output", "errors", "expected"),
    [
        ('{"dependencies": [{"name": "a", "version": "1", "vulns": []}]}', "", []),
        (
            '{"dependencies": [{"name": "a", "version": "1", "vulns": [{"id": "X-1"}]}]}',
            "",
            ["a 1: X-1"],
        ),
        ("", "python: No module named pip_audit", "not reached: pip install -r "),
        ("", "WARNING: x\nConnectionError: no route", "not reached: ConnectionError: no route"),
        ("", "", "not reached: no answer"),
    ],
)
def test_an_audit_lists_vulnerabilities_or_says_that_it_reached_nobody(output, errors, expected):
    found = dependencies.read_audit(output, errors)
    is_text = isinstance(expected, str)
    assert found.startswith(expected) if is_text else found == expected


def test_libraries_have_permissive_licences():
    names = dependencies.list_locked()
    assert {"numpy", "ray", "psycopg"} <= set(names)
    assert dependencies.find_licence_faults(names)[0] == []


def test_a_licence_that_is_not_permissive_is_named(monkeypatch):
    monkeypatch.setattr(dependencies, "LINKED_FREELY", ())
    faults, absent = dependencies.find_licence_faults(["psycopg", "no-such-package"])
    assert faults == ["psycopg: LGPL-3.0-only"]
    assert absent == ["no-such-package"]
