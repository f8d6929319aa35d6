"""Ties, groups, criteria and profiles of a run that was identified, over REST."""

from collections.abc import Iterator
from typing import Any

import pytest
from typer.testing import CliRunner

import service.runs.profiles
from service.cli import common
from service.cli.run_commands import app as runs_app
from service.client.client import Client
from tests.support.service.local_runs import ServedRun, serve_run
from tests.support.service.web_app import Through, read_faults

SMALL = {"population": 20, "generations": 60, "islands": 1}
MODEL: dict[str, Any] = {
    "name": "products",
    "form": "differential",
    "inputs": {"u": "V"},
    "states": {"x": "m"},
    "parameters": {name: {"lower": 0.1, "upper": 5} for name in ("k", "A", "J", "T", "r")}
    | {"L": {"lower": 0, "upper": 2, "unit": "s"}},
    "equations": {"x": "(k*A*u(t - L)/J - r*x)/T"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}


@pytest.fixture(scope="module")
def served_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServedRun]:
    changes = {
        "model": MODEL,
        "algorithm": SMALL,
        "noise": {"sigma": 0.02},
        "parameters": {"r": {"fixed": 1}, "T": {"tied": "r"}},
        "validation": {"fraction": 0.2},
    }
    with serve_run(tmp_path_factory.mktemp("profiles"), **changes) as run:
        yield run


def read_result(served_run: ServedRun) -> dict[str, Any]:
    document: dict[str, Any] = served_run.server.get(f"/v1/runs/{served_run.run}").json()
    assert document["state"] == "succeeded", document["error"]
    return document


def test_groups_ties_and_criteria_are_in_the_result(served_run: ServedRun) -> None:
    document = read_result(served_run)
    (group,) = document["identifiability"]["groups"]
    assert group["expression"] == "k*A/J"
    assert group["members"] == ["k", "A", "J"]
    assert group["value"] == pytest.approx(2.0, rel=0.05)
    assert group["stderr"] < 0.05
    states = {one["name"]: one["status"] for one in document["parameters"]}
    explained = {name for one in document["findings"] for name in one["parameters"]}
    assert states.pop("L") == ("dependent" if "L" in explained else "identified")
    assert states == {
        "k": "group",
        "A": "group",
        "J": "group",
        "T": "tied",
        "r": "fixed",
    }
    assert set(document["criteria"]) == {"aic", "aicc", "bic", "samples", "parameters"}
    assert document["criteria"]["parameters"] == 4


def test_the_minima_and_whether_the_search_settled_are_in_the_result(served_run: ServedRun) -> None:
    document = served_run.server.get(f"/v1/runs/{served_run.run}").json()
    search = document["search"]
    assert search["settled"] is (search["because"] is not None)
    assert 0 <= search["agreeing_starts"] <= search["independent_starts"]
    lowest = search["minima"][0]
    values = {one["name"]: one["value"] for one in document["parameters"]}
    assert set(lowest["parameters"]) <= set(values)
    assert (lowest["likelihood_ratio"], lowest["is_compatible"]) == (0.0, True)
    assert lowest["rms"] == pytest.approx(document["rms"], rel=1e-3)
    page = served_run.server.get(f"/runs/{served_run.run}", headers={"accept": "text/html"}).text
    assert "independent starts ended here" in page
    history = served_run.server.get(f"/v1/runs/{served_run.run}/history").json()
    assert history["names"] == ["k", "A", "J", "L"]


def test_a_profile_has_the_interval_and_its_figure(served_run: ServedRun) -> None:
    body = {"parameters": ["L"], "points": 9}
    answer = served_run.server.post(f"/v1/runs/{served_run.run}:profile", json=body).json()
    (one,) = answer["profiles"]
    estimate = next(e for e in read_result(served_run)["parameters"] if e["name"] == "L")
    low, high = one["interval95"]
    assert low < estimate["value"] < high
    assert one["estimate"] == pytest.approx(estimate["value"])
    assert one["ratio"][0] > answer["threshold"]
    assert set(one["others"]) == {"k", "A", "J"}
    gains = [
        k * a / j for k, a, j in zip(*(one["others"][p] for p in ("k", "A", "J")), strict=True)
    ]
    assert gains == pytest.approx([2.0] * len(one["values"]), rel=0.05)
    trace = answer["figure"]["data"][0]
    assert trace["x"] == one["values"]
    assert trace["y"] == one["ratio"]


def test_a_member_of_a_group_has_an_open_profile(served_run: ServedRun) -> None:
    body = {"parameters": ["J"], "points": 5}
    answer = served_run.server.post(f"/v1/runs/{served_run.run}:profile", json=body).json()
    assert answer["profiles"][0]["interval95"] == [None, None]


def test_a_profile_that_cannot_be_had_is_refused(
    served_run: ServedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"/v1/runs/{served_run.run}:profile"
    fault = read_faults(served_run.server.post(url, json={"parameters": ["LL"]}), 422, "invalid")[0]
    assert fault["pointer"] == "/parameters/0"
    assert "did you mean 'L'?" in fault["detail"]
    fault = read_faults(served_run.server.post(url, json={"points": 2}), 422, "invalid")[0]
    assert fault["pointer"] == "/points"
    read_faults(served_run.server.post("/v1/runs/run_0:profile", json={}), 404, "not-found")
    monkeypatch.setattr(service.runs.profiles, "LIMIT_SECONDS", -1.0)
    fault = read_faults(served_run.server.post(url, json={"parameters": ["L"]}), 422, "invalid")[0]
    assert "were stopped at 'L'" in fault["detail"]
    monkeypatch.setattr(service.runs.profiles, "MAX_WORK", 10)
    fault = read_faults(served_run.server.post(url, json={}), 422, "invalid")[0]
    assert "need at most 10" in fault["detail"]


def test_the_command_tells_intervals(
    served_run: ServedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        common,
        "connect_client",
        lambda *_: Client("http://testserver", transport=Through(served_run.server)),
    )
    told = CliRunner().invoke(runs_app, ["profile", served_run.run, "L", "--points", "7"])
    assert told.exit_code == 0, told.output
    assert "estimate" in told.output
    assert "L" in told.output
