"""The setting `initial` of a job, and what is computed from a run that started at rest."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from starlette.testclient import TestClient

from service.formats.mcap.mcap_files import read_fitted_outputs
from sysid.models.parse import parse_model
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import parts_of, store_csv

TIMES = 0.5 * np.arange(160)
STEP = np.where(TIMES >= 1.0, 20.0, 0.0)


class RestedRun(NamedTuple):
    """An application with a run from rest, its dataset and its result."""

    server: TestClient
    run: str
    dataset: str
    found: dict[str, Any]


@pytest.fixture(scope="module")
def dataset(server: TestClient) -> str:
    rise = np.where(TIMES > 6.0, 5.8 * (1.0 - np.exp(-(TIMES - 6.0) / 15.0)), 0.0)
    noise = 0.1 * np.random.default_rng(12).standard_normal(TIMES.size)
    rows = [
        f"{t:g},{u:g},{y:.6f}" for t, u, y in zip(TIMES, STEP, 24.7 + rise + noise, strict=True)
    ]
    return store_csv(server, "\n".join(["t,u,y", *rows, ""]).encode())


@pytest.fixture(scope="module")
def start_run(server: TestClient, dataset: str) -> RestedRun:
    body = {
        "model": "fopdt",
        "datasets": [dataset],
        "initial": "rest",
        "validation": {"fraction": 0.2},
        "algorithm": {"population": 16, "generations": 60},
    }
    _, (run,) = identify_job(parts_of(server), body)
    return RestedRun(server, run, dataset, server.get(f"/v1/runs/{run}").json())


def test_a_run_from_rest_has_no_start(start_run: RestedRun) -> None:
    assert start_run.found["initial"] == "rest"
    assert [one["name"] for one in start_run.found["parameters"]] == ["K", "T", "L", "y0"]


def test_a_simulation_begins_at_rest(start_run: RestedRun) -> None:
    inlet = {"kind": "series", "times": TIMES.tolist(), "values": STEP.tolist(), "hold": "zero"}
    body = {"samples": TIMES.size, "sample_time": 0.5, "inputs": {"u": inlet}}
    answer = start_run.server.post(f"/v1/runs/{start_run.run}:simulate", json=body)
    assert answer.status_code == 200, answer.text
    [y] = answer.json()["outputs"]
    [offset] = [one["value"] for one in start_run.found["parameters"] if one["name"] == "y0"]
    assert y["values"][0] == pytest.approx(offset)
    signals = start_run.server.get(f"/v1/runs/{start_run.run}/signals.mcap").content
    fitted = read_fitted_outputs(signals)[0].simulated
    np.testing.assert_allclose(y["values"][: fitted.size], fitted, rtol=1e-9)


def test_what_is_computed_later_begins_at_rest_too(start_run: RestedRun) -> None:
    path = f"/v1/runs/{start_run.run}"
    document = start_run.server.get(f"{path}/export", params={"format": "json"}).json()
    assert parse_model(document["model"]).document["initial"] == {"x": "steady"}
    body = {"parameters": ["K"], "points": 5}
    [profile] = start_run.server.post(f"{path}:profile", json=body).json()["profiles"]
    assert min(profile["rms"]) == pytest.approx(start_run.found["rms"])
    answer = start_run.server.post(f"{path}:validate", json={"dataset": start_run.dataset})
    assert answer.status_code == 200, answer.text


@pytest.mark.parametrize(
    ("initial", "told"),
    [
        ("resting", "found 'resting'; need 'rest', 'free', 'measured' or 'auto'"),
        ("measured", "'measured' has no meaning for model 'fopdt': no output is a state"),
    ],
)
def test_a_start_that_cannot_be_is_refused_at_its_field(
    server: TestClient, dataset: str, initial: str, told: str
) -> None:
    body = {"model": "fopdt", "datasets": [dataset], "initial": initial}
    answer = server.post("/v1/jobs", json=body)
    assert answer.status_code == 422
    [fault] = answer.json()["errors"]
    assert fault["pointer"] == "/initial"
    assert told in fault["detail"]


def test_a_start_that_a_rest_determines_is_no_parameter(server: TestClient, dataset: str) -> None:
    body = {"model": "fopdt", "datasets": [dataset], "parameters": {"x(0)": {"fixed": 0}}}
    assert server.post("/v1/jobs", json=body).status_code == 202
    answer = server.post("/v1/jobs", json={**body, "initial": "rest"})
    assert answer.status_code == 422
    assert "/parameters/x(0)" in answer.text
