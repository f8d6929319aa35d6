"""`lagid paper` over a service: the report's numbers are those of the jobs."""

import json
import re
from pathlib import Path

import pytest

from service.client.client import Client
from tests.commands import check_refusal, run_lagid
from tests.standing import Service

pytestmark = [pytest.mark.slow, pytest.mark.ray, pytest.mark.timeout(600)]


@pytest.fixture
def url(service: Service) -> str:
    """The address of the standing service."""
    return service.stand.url


def test_the_tables_hold_the_estimates_of_the_jobs(url: str, tmp_path: Path) -> None:
    report = tmp_path / "paper.html"
    done = run_lagid("paper", "--quick", "--only", "table1", "--url", url, "--output", report)
    assert done.code == 0, done.stderr
    page = report.read_text(encoding="utf-8")
    jobs = dict.fromkeys(re.findall(r"job_[0-9a-z]{26}", page))
    assert len(jobs) == 3  # one for each reading
    with Client(url) as client:
        runs = [run for job in jobs for run in client.runs(job)]
    assert len(runs) == 9
    for run in runs:
        assert f"{run['rms']:.6f}" in done.stdout
        assert f">{run['rms']:.6f}<" in page
        assert f">{run['evaluations']}<" in page
    figures = re.findall(r'id="figure-[\d-]+">(.*?)</script>', page)
    assert len(figures) == 12
    assert all(json.loads(text)["data"] for text in figures)


def test_without_its_data_the_tube_is_that_of_the_plant(url: str, tmp_path: Path) -> None:
    report = tmp_path / "paper.html"
    words = ("--only", "table3", "--url", url, "--output", report)
    done = run_lagid("paper", *words, LAGID_DATA=str(tmp_path))
    assert done.code == 0, done.stderr
    assert "LAGID_DATA has no records, so the service made them" in done.stdout
    assert "L of the two patterns agrees" in report.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "told", "code"),
    [
        (["--only", "table9"], "--only: the study has no part 'table9'; need some of series", 1),
        (["--output", "no/a.html"], "--output no/a.html: there is no folder no", 2),
    ],
)
def test_what_cannot_be_done_is_refused_before_any_work(
    words: list[str], told: str, code: int
) -> None:
    done = run_lagid("paper", *words, "--url", "http://127.0.0.1:1")
    assert told in check_refusal(done, code)
