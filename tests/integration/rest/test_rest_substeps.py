"""A run that needed a finer step is simulated, validated and exported with that step."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from starlette.testclient import TestClient

from service.formats.mcap.mcap_files import read_fitted_outputs
from sysid.data.records import Channel
from sysid.models.parse import parse_model
from sysid.simulation.simulate import simulate
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import parts_of, store_csv

N = 200
TWO_LAGS: dict[str, Any] = {
    "name": "two-lags",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"w": "1", "x": "1"},
    "parameters": {
        "K": {"lower": -10, "upper": 10},
        "T": {"lower": 0.5, "upper": 50, "unit": "s"},
        "r": {"lower": 0.005, "upper": 1, "scale": "log"},
    },
    "equations": {"w": "(K*u - w)/T", "x": "(w - x)/(r*T)"},
    "outputs": {"y": "x"},
    "initial": {"w": 0, "x": 0},
}


class FineRun(NamedTuple):
    """An application with a run, its dataset, its result and the input as a signal."""

    server: TestClient
    run: str
    dataset: str
    found: dict[str, Any]
    inlet: dict[str, Any]


@pytest.fixture(scope="module")
def fine_run(server: TestClient) -> FineRun:
    random = np.random.default_rng(1)
    times = np.arange(N, dtype=np.float64)
    inlet = Channel("u", times, np.repeat(random.standard_normal(N // 5), 5).round(3), hold="zero")
    plant = parse_model({**TWO_LAGS, "solver": {"substeps": 200}})
    y = simulate(plant, [inlet], {"K": 2.0, "T": 8.0, "r": 0.02}, times=times).channel("y").values
    y = y + random.normal(0.0, 0.01, N)
    rows = [f"{t:g},{u:g},{v:.6f}" for t, u, v in zip(times, inlet.values, y, strict=True)]
    dataset = store_csv(server, "\n".join(["t,u,y", *rows, ""]).encode())
    body = {
        "model": TWO_LAGS,
        "datasets": [dataset],
        "hold": {"u": "zero"},
        "algorithm": {"population": 16, "generations": 40},
    }
    _, (run,) = identify_job(parts_of(server), body)
    found = server.get(f"/v1/runs/{run}").json()
    series = {"kind": "series", "times": times.tolist(), "values": inlet.values.tolist()}
    return FineRun(server, run, dataset, found, {**series, "hold": "zero"})


def test_the_result_has_its_substeps(fine_run: FineRun) -> None:
    assert fine_run.found["substeps"] > 1
    [note] = [text for text in fine_run.found["warnings"] if "substeps: 1" in text]
    assert f"substeps: {fine_run.found['substeps']}:" in note


def wait_for_fit(fine_run: FineRun) -> Any:
    answer = fine_run.server.get(f"/v1/runs/{fine_run.run}/signals.mcap")
    [fit] = read_fitted_outputs(answer.content)
    return fit


def test_a_simulation_is_that_of_the_fitted_signals(fine_run: FineRun) -> None:
    body = {
        "samples": N,
        "sample_time": 1.0,
        "inputs": {"u": fine_run.inlet},
    }
    answer = fine_run.server.post(f"/v1/runs/{fine_run.run}:simulate", json=body)
    assert answer.status_code == 200, answer.text
    [y] = answer.json()["outputs"]
    np.testing.assert_allclose(y["values"], wait_for_fit(fine_run).simulated, rtol=1e-9, atol=1e-9)


def test_a_free_run_on_its_own_data_has_the_error_of_the_result(fine_run: FineRun) -> None:
    answer = fine_run.server.post(
        f"/v1/runs/{fine_run.run}:validate", json={"dataset": fine_run.dataset}
    )
    assert answer.status_code == 200, answer.text
    assert answer.json()["rms"] == pytest.approx(fine_run.found["rms"])


@pytest.mark.parametrize("name", ["K", "r"])
def test_a_profile_is_lowest_at_the_estimate(fine_run: FineRun, name: str) -> None:
    body = {"parameters": [name], "points": 5}
    answer = fine_run.server.post(f"/v1/runs/{fine_run.run}:profile", json=body)
    assert answer.status_code == 200, answer.text
    [profile] = answer.json()["profiles"]
    assert min(profile["rms"]) == pytest.approx(fine_run.found["rms"])


def test_exports_have_the_substeps(fine_run: FineRun) -> None:
    substeps = fine_run.found["substeps"]
    path = f"/v1/runs/{fine_run.run}/export"
    document = fine_run.server.get(path, params={"format": "json"}).json()
    assert parse_model(document["model"]).solver.substeps == substeps
    for form, text in (("python", f"/{substeps}"), ("c", f"/{substeps}.0")):
        assert f"{text}" in fine_run.server.get(path, params={"format": form}).text
