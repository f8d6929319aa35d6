"""The example that reproduces the paper over a service: its numbers are those of the jobs."""

import re
import sys
from pathlib import Path

import pytest

from examples.paper.__main__ import main
from service.client.client import Client
from tests.support.service.whole_service import Service

pytestmark = [pytest.mark.slow, pytest.mark.ray, pytest.mark.timeout(600)]


@pytest.fixture
def url(service: Service) -> str:
    """The address of the standing service."""
    return service.stand.url


def conduct(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["paper", *map(str, words)])
    main()


def test_the_tables_hold_the_estimates_of_the_jobs(
    url: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    report = tmp_path / "paper.html"
    conduct(monkeypatch, "--quick", "--only", "table1", "--url", url, "--output", report)
    printed, page = capsys.readouterr().out, report.read_text(encoding="utf-8")
    jobs = dict.fromkeys(re.findall(r"job_[0-9a-z]{26}", page))
    assert len(jobs) == 3  # one for each reading
    with Client(url) as client:
        runs = [run for job in jobs for run in client.runs(job)]
    assert len(runs) == 9
    for run in runs:
        assert f"{run['rms']:.6f}" in printed
        assert f">{run['rms']:.6f}<" in page
        assert f">{run['evaluations']}<" in page
    drawn = re.findall(r'Plotly\.newPlot\(\s*"(figure-[\d-]+)",\s*\[\{', page)
    assert len({*drawn}) == 12
    assert {*drawn} == {*re.findall(r'<div id="(figure-[\d-]+)"', page)}


def test_the_tube_is_that_of_the_plant(
    url: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    report = tmp_path / "paper.html"
    conduct(monkeypatch, "--only", "table3", "--url", url, "--output", report)
    printed, page = capsys.readouterr().out, report.read_text(encoding="utf-8")
    for text in (printed, page):
        assert "L of the two patterns agrees within 10 ms" in text
        assert "T of the two patterns agrees within 3 %" in text
    assert "does NOT hold" not in printed


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--only", "table9"], "--only: the study has no part 'table9'; need some of series"),
        (["--output", "no/a.html"], "--output: there is no folder no"),
    ],
)
def test_what_cannot_be_done_is_refused_before_any_work(
    words: list[str],
    told: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as end:
        conduct(monkeypatch, *words, "--url", "http://127.0.0.1:1")
    assert end.value.code == 2
    assert told in capsys.readouterr().err


def test_an_absent_server_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SystemExit, match=r"examples\.paper: .*127\.0\.0\.1:1"):
        conduct(monkeypatch, "--only", "table1", "--url", "http://127.0.0.1:1")
