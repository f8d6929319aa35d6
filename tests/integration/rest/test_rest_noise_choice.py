"""The noise model that is chosen where none is asked for, over REST."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from starlette.testclient import TestClient

from service.api.requests.dependencies import Parts
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import parts_of, read_faults, store_csv
from tests.unit.sysid.noise_models.test_noise_model_choice import (
    LAG,
    STEP,
    TANK,
    N,
    build_plant,
    make_signal,
    simulate_delayed,
    simulate_disturbed,
)
from tests.unit.sysid.residuals.test_coloured import colour_noise

SMALL = {"population": 24, "generations": 20, "islands": 1}


class PlantRecords(NamedTuple):
    """An application with a recording of a disturbed tank, and of a lag with a dead time.

    And of a tank that nothing disturbs, whose level is measured with white noise.
    """

    server: TestClient
    parts: Parts
    tank: str
    lag: str
    quiet: str


@pytest.fixture(scope="module")
def plants(server: TestClient) -> PlantRecords:
    parts = parts_of(server)
    names = []
    quiet = build_plant(0.0, np.zeros(N)) + 0.05 * colour_noise(N, 0.0, 7)
    outputs = {"tank": simulate_disturbed(2), "lag": simulate_delayed(2), "quiet": quiet}
    for name, output in outputs.items():
        pairs = zip(make_signal(), output, strict=True)
        lines = [
            "t,u,y",
            *(f"{k * STEP:.6g},{u},{float(y)!r}" for k, (u, y) in enumerate(pairs)),
        ]
        names.append(store_csv(server, "\n".join(lines).encode(), name))
    return PlantRecords(server, parts, *names)


def run(plants: PlantRecords, model: dict[str, Any], dataset: str, **more: Any) -> dict[str, Any]:
    body = {"model": model, "datasets": [dataset], "algorithm": SMALL, "hold": {"u": "zero"}}
    _, (name,) = identify_job(plants.parts, {**body, **more})
    document: dict[str, Any] = plants.server.get(f"/v1/runs/{name}").json()
    assert document["state"] == "succeeded", document["error"]
    return document


def read_values(document: dict[str, Any]) -> list[float]:
    return [one["value"] for one in document["parameters"]]


def list_notes(plants: PlantRecords, *documents: dict[str, Any]) -> list[str]:
    body = {"runs": [one["id"] for one in documents]}
    told = plants.server.post("/v1/runs:compare", json=body).json()["notes"]
    return [text for text in told if "different losses" in text]


def test_a_tank_has_generalised_least_squares_unless_squares_are_asked_for(
    plants: PlantRecords,
) -> None:
    auto, white, ar1 = (
        run(plants, TANK, plants.tank, **({} if name is None else {"loss": {"noise_model": name}}))
        for name in (None, "white", "ar1")
    )
    assert [one["noise_model"] for one in (auto, white, ar1)] == ["ar1", "white", "ar1"]
    assert read_values(auto) == read_values(ar1) != read_values(white)
    assert sum("(loss: {noise_model: white})" in text for text in auto["warnings"]) == 1
    assert list_notes(plants, auto, white)
    assert not list_notes(plants, auto, ar1)
    faults = read_faults(
        plants.server.post(f"/v1/runs/{auto['id']}:profile", json={"parameters": ["K"]}),
        422,
        "invalid",
    )
    assert faults[0]["pointer"] == "/loss/noise_model"


def test_a_lag_has_squares_which_are_profiled_and_compared_as_such(plants: PlantRecords) -> None:
    auto = run(plants, LAG, plants.lag)
    white = run(plants, LAG, plants.lag, loss={"noise_model": "white"})
    assert auto["noise_model"] == white["noise_model"] == "white"
    assert auto["reused_from"] is None
    assert read_values(auto) == read_values(white)
    assert auto["warnings"] == white["warnings"]
    assert not list_notes(plants, auto, white)
    path, body = f"/v1/runs/{auto['id']}:profile", {"parameters": ["K"], "points": 5}
    assert plants.server.post(path, json=body).status_code == 200


def test_predictions_and_robust_losses_need_no_noise_model_named(plants: PlantRecords) -> None:
    robust = run(plants, TANK, plants.tank, loss={"kind": "soft-l1", "scale": 1.0})
    ahead = run(plants, TANK, plants.tank, prediction="one-step")
    assert robust["noise_model"] == ahead["noise_model"] == "white"


def trend_notes(plants: PlantRecords, datasets: list[str], **more: Any) -> list[str]:
    labels = [{"level": k + 1} for k in range(len(datasets))]
    axis = {"path": "/datasets", "values": [[one] for one in datasets], "labels": labels}
    body = {"model": TANK, "algorithm": SMALL, "hold": {"u": "zero"}, "sweep": {"axes": [axis]}}
    job, _ = identify_job(
        plants.parts, {**body, "datasets": datasets[:1], "trend": {"x": "level"}, **more}
    )
    told: list[str] = plants.server.get(f"/v1/jobs/{job}/trend").json()["notes"]
    return told


def test_a_trend_tells_which_of_its_runs_are_of_another_noise_model(plants: PlantRecords) -> None:
    (note,) = trend_notes(plants, [plants.tank, plants.quiet])
    assert "estimates of level = 1 use the noise model ar1, others use least squares" in note
    assert "loss: {noise_model: white}" in note
    assert not trend_notes(plants, [plants.tank, plants.quiet], loss={"noise_model": "white"})
    assert not trend_notes(plants, [plants.tank])
