"""`lagid identify --report`: one file with the tables and figures of the result."""

import json
import re
from pathlib import Path

import pytest

from service.core import extras
from service.pages.render import plotly_script
from tests.support.service.commands import check_refusal, run_lagid
from tests.support.service.web_app import recording

QUICK = ("--set", "algorithm.population=40", "--set", "algorithm.generations=60")
WORDS = ("--model", "fopdt", "--set", "validation.fraction=0.3", *QUICK)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recordings") / "steps <b>.csv"
    path.write_bytes(recording())
    return path


@pytest.fixture(scope="module")
def report(data: Path) -> str:
    path = data.parent / "report.html"
    done = run_lagid("identify", str(data), *WORDS, "--report", str(path))
    assert done.code == 0, done.stderr
    assert f"report written to {path}" in done.stderr
    return path.read_text(encoding="utf-8")


def read_figures(report: str) -> dict[str, dict]:
    """Figures by their titles, from the JSON that the report carries."""
    places = re.findall(
        r'<h2>([^<]*)</h2></header><div class="plot"[^>]*data-source="([^"]*)"', report
    )
    texts = dict(
        re.findall(r'<script type="application/json" id="([^"]*)">(.*?)</script>', report, re.S)
    )
    return {title: json.loads(texts[place]) for title, place in places}


def test_the_report_has_the_figures_of_a_jobs_report(report: str) -> None:
    figures = read_figures(report)
    assert list(figures) == [
        "Progress of every island",
        "Measured against identified",
        "Correlation of the residuals",
        "Convergence of the parameters",
        "Correlation of the estimates",
        "What each island found",
    ]
    traces = {trace["name"]: trace for trace in figures["Measured against identified"]["data"]}
    assert len(traces["u"]["x"]) == len(traces["measured"]["x"])  # also in the validation part
    assert figures["Measured against identified"]["layout"]["shapes"]


def test_the_report_has_tables_model_and_request(report: str) -> None:
    for name in ("K", "T", "L"):
        assert f'<th scope="row">{name}</th>' in report
    assert "independent of u" in report
    assert "equations:" in report
    assert "&#34;population&#34;: 40" in report


def test_the_report_needs_no_network_and_escapes_names(report: str) -> None:
    assert str(plotly_script()) in report
    rest = report.replace(str(plotly_script()), "")
    assert not re.search(r'(?:src|href)="(?!#|data:)', rest)
    assert "steps &lt;b&gt;.csv" in rest
    assert "steps <b>" not in rest
    assert "default-src &#39;none&#39;" in rest


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("absent/a.html", "--report absent/a.html: there is no folder absent"),
        (".", "--report .: this is a folder; name a file"),
    ],
)
def test_a_place_that_cannot_be_written_is_refused_before_the_search(
    data: Path, place: str, told: str
) -> None:
    words = ["identify", str(data), "--model", "fopdt", "--report", place]
    assert told in check_refusal(run_lagid(*words), 2)


def test_a_report_is_overwritten_only_if_that_is_asked_for(data: Path, tmp_path: Path) -> None:
    report = tmp_path / "old.html"
    report.write_text("old")
    words = ["identify", str(data), *WORDS, "--report", str(report)]
    assert check_refusal(run_lagid(*words)).endswith(
        "exists, and nothing was written. Add --force, or name another by --report"
    )
    assert report.read_text() == "old"
    assert run_lagid(*words, "--force").code == 0
    assert report.read_text().startswith("<!doctype html>")


def test_a_report_without_its_libraries_is_refused_before_the_search(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "list_missing", lambda _: ["ray", "plotly"])
    words = ["identify", str(data), "--model", "fopdt", "--report", "a.html"]
    told = "--report needs plotly, not installed here: pip install 'lagid[server]'"
    assert told in check_refusal(run_lagid(*words))


def test_the_report_and_the_result_say_how_channels_were_assigned(tmp_path: Path) -> None:
    path, result = tmp_path / "swapped.csv", tmp_path / "result.json"
    rows = recording().decode().splitlines()[1:]
    cells = [row.split(",") for row in rows]
    path.write_text("t,Oven out,Heater\n" + "\n".join(f"{t},{y},{u}" for t, u, y in cells))
    files = ("--report", str(tmp_path / "report.html"), "--output", str(result))
    done = run_lagid("identify", str(path), "--model", "fopdt", *QUICK, *files)
    assert done.code == 0, done.stderr
    option = "--channels 'u=Oven out,y=Heater'"  # as a shell reads it
    note = f"channels were assigned by their order. To choose, give {option}"
    assert done.stderr.count(note) == 1
    assert "Perhaps inputs and outputs are swapped" in done.stderr
    assert any(note in warning for warning in json.loads(result.read_text())["warnings"])
    shown = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "channels were assigned by their order" in shown
