"""A run of a sweep is concluded without explanations, and explained when it is opened."""

import re
from typing import Any, NamedTuple

import numpy as np
import pytest
from starlette.testclient import TestClient

from service.core.computed import ComputedValues
from service.jobs.stored_run import StoredRun
from service.repositories.project_rows import ProjectRepository
from service.runs import bands, explained, fitted
from service.storage.storage_errors import ObjectMissing
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import parts_of, store_csv

PERIOD, N = 0.5, 600
T, CHANGE = 3.0, 150.0


class Swept(NamedTuple):
    """An application with a sweep over two seeds, and its dataset."""

    server: TestClient
    job: str
    runs: list[str]
    dataset: str

    def list_runs(self) -> list[dict[str, Any]]:
        items: list[dict[str, Any]] = self.server.get(f"/v1/jobs/{self.job}/runs").json()["items"]
        return items

    def count_evaluations(self) -> int:
        return int(self.server.get("/v1/access").json()["used"]["daily_evaluations"])

    def limit_evaluations(self, most: int | None) -> None:
        with parts_of(self.server).database.write_session() as session:
            ProjectRepository(session).change_limits("default", {"max_daily_evaluations": most})

    def open_run(self, number: int) -> dict[str, Any]:
        document: dict[str, Any] = self.server.get(f"/v1/runs/{self.runs[number]}").json()
        return document


def write_lag_change() -> bytes:
    """First order, exactly, whose dead time changes from 2 to 2.5 s in the middle."""
    random = np.random.default_rng(5)
    times = PERIOD * np.arange(N)
    u = np.repeat(random.uniform(0.0, 4.0, N // 20), 20).round(3)
    decay, y = np.exp(-PERIOD / T), np.zeros(N)
    for k in range(1, N):
        lag = round((2.0 if times[k] < CHANGE else 2.5) / PERIOD)
        y[k] = decay * y[k - 1] + 2.0 * (1.0 - decay) * u[max(k - 1 - lag, 0)]
    y += random.normal(0.0, 0.02, N)
    rows = [f"{t:g},{a:g},{b:.5f}" for t, a, b in zip(times, u, y, strict=True)]
    return "\n".join(["t,u,y", *rows, ""]).encode()


@pytest.fixture(scope="module")
def swept(server: TestClient) -> Swept:
    dataset = store_csv(server, write_lag_change(), "lag change")
    body = {
        "model": "fopdt",
        "datasets": [dataset],
        "hold": {"u": "zero"},
        "loss": {"noise_model": "white"},
        "algorithm": {"population": 24, "generations": 30, "islands": 1},
        "sweep": {"axes": [{"path": "/noise/sigma", "values": [0.0, 0.3]}]},
        "name": "swept",
    }
    job, runs = identify_job(parts_of(server), body)
    return Swept(server, job, runs, dataset)


def test_a_list_of_runs_has_what_the_sweep_concluded(swept: Swept) -> None:
    for run in swept.list_runs():
        assert run["state"] == "succeeded", run["error"]
        assert run["explained"] is False
        assert not any(one["family"] in ("constancy", "clocks") for one in run["findings"])


def test_a_run_that_is_opened_has_its_residuals_explained(swept: Swept) -> None:
    stored, opened = swept.list_runs()[0], swept.open_run(0)
    assert opened["explained"] is True
    [change, *_] = [one for one in opened["findings"] if one["moves"]]
    assert change["family"] in ("constancy", "clocks")
    assert change["gain"] > 12
    assert "L" in change["parameters"]
    statuses = {one["name"]: one["status"] for one in opened["parameters"]}
    assert statuses["L"] == "dependent"
    assert opened["verdict"]["trust"] != "trustworthy"
    assert change["brief"] in opened["verdict"]["text"]
    assert "why was not looked for" in " ".join(stored["warnings"])
    assert "why was not looked for" not in " ".join(opened["warnings"])
    values = [[one["value"] for one in run["parameters"]] for run in (stored, opened)]
    assert values[0] == values[1]
    assert opened == swept.open_run(0)


def test_its_page_shows_the_open_explanations_once(swept: Swept) -> None:
    opened, text = swept.open_run(0), swept.server.get(f"/runs/{swept.runs[0]}").text
    assert opened["verdict"]["text"] in text
    assert "why was not looked for" not in text
    table = text.partition("<h2>Open explanations</h2>")[2].partition("</table>")[0]
    assert "L [s]" in table
    rows = re.findall(r'<tr><th scope="row">(.*?)</th>', table)
    assert rows[0] == "the model holds"
    doubts = [one for one in opened["findings"] if one["severity"] != "note"]
    assert rows[1:] == [one["brief"] for one in doubts if one["moves"]]
    for one in doubts:
        assert text.count(one["text"].partition(". ")[0] + ".") <= 1


def test_the_list_of_jobs_names_the_run_whose_verdict_it_shows(swept: Swept) -> None:
    outcome = swept.server.get(f"/v1/jobs/{swept.job}").json()["outcome"]
    assert outcome["cell"] == {"/noise/sigma": 0.0}
    page = swept.server.get("/").text
    row = page.partition(f'<tr data-job="{swept.job}"')[2].partition("</tr>")[0]
    assert "sigma 0: the best of 2 succeeded" in row


def test_a_run_whose_recording_is_gone_stays_as_it_was_stored(
    swept: Swept, monkeypatch: pytest.MonkeyPatch
) -> None:
    def miss(*_: object) -> None:
        raise ObjectMissing("it was deleted")

    monkeypatch.setattr(StoredRun, "problem", miss)
    stored, opened = swept.list_runs()[1], swept.open_run(1)
    assert opened["explained"] is False
    assert opened["verdict"] == stored["verdict"]
    assert swept.server.get(f"/runs/{swept.runs[1]}").status_code == 200


def test_what_would_take_long_is_left_as_it_was_stored(
    swept: Swept, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(explained, "MAX_WORK", 10)
    assert swept.open_run(1)["explained"] is False


@pytest.fixture
def forgetful(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was computed before is computed again."""
    for module, name in (
        (explained, "_explained"),
        (bands, "_computed_bands"),
        (fitted, "_computed_signals"),
    ):
        monkeypatch.setattr(module, name, ComputedValues(4))


@pytest.mark.usefixtures("forgetful")
@pytest.mark.parametrize(("part", "least"), [("", 30), ("/bands", 8), ("/response", 1)])
def test_what_is_computed_to_show_a_run_counts_once(swept: Swept, part: str, least: int) -> None:
    before = swept.count_evaluations()
    for _ in range(2):
        assert swept.server.get(f"/v1/runs/{swept.runs[0]}{part}").status_code == 200
    assert least <= swept.count_evaluations() - before < 5000
    after = swept.count_evaluations()
    assert swept.server.get(f"/v1/runs/{swept.runs[0]}{part}").status_code == 200
    assert swept.count_evaluations() == after


@pytest.mark.usefixtures("forgetful")
def test_without_evaluations_left_a_run_is_shown_as_it_was_stored(swept: Swept) -> None:
    swept.limit_evaluations(1)
    try:
        address = f"/v1/runs/{swept.runs[0]}"
        assert swept.open_run(0)["explained"] is False
        assert swept.server.get(f"{address}/bands").status_code == 429
        assert swept.server.get(f"{address}/response").status_code == 200
        assert swept.server.get(f"/runs/{swept.runs[0]}").status_code == 200
        figure = swept.server.get(f"{address}/figures/response").json()
        assert [trace["name"] for trace in figure["data"][:2]] == ["measured", "identified"]
    finally:
        swept.limit_evaluations(None)
    assert swept.open_run(0)["explained"] is True
    assert swept.server.get(f"{address}/bands").status_code == 200
