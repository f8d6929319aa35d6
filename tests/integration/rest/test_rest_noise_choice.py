"""The noise model that is chosen where none is asked for, over REST."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from starlette.testclient import TestClient

from service.api.dependencies import Parts
from tests.identified import identified
from tests.rest import parts_of, refused, store_csv
from tests.unit.sysid.noise_models.test_noise_model_choice import (
    LAG,
    STEP,
    TANK,
    N,
    delayed,
    disturbed,
    plant,
    signal,
)
from tests.unit.sysid.residuals.test_coloured import coloured

SMALL = {"population": 24, "generations": 20, "islands": 1}


class Served(NamedTuple):
    """An application with a recording of a disturbed tank, and of a lag with a dead time.

    And of a tank that nothing disturbs, whose level is measured with white noise.
    """

    server: TestClient
    parts: Parts
    tank: str
    lag: str
    quiet: str


@pytest.fixture(scope="module")
def served(server: TestClient) -> Served:
    parts = parts_of(server)
    names = []
    quiet = plant(0.0, np.zeros(N)) + 0.05 * coloured(N, 0.0, 7)
    outputs = {"tank": disturbed(2), "lag": delayed(2), "quiet": quiet}
    for name, output in outputs.items():
        pairs = zip(signal(), output, strict=True)
        lines = [
            "t,u,y",
            *(f"{k * STEP:.6g},{u},{float(y)!r}" for k, (u, y) in enumerate(pairs)),
        ]
        names.append(store_csv(server, "\n".join(lines).encode(), name))
    return Served(server, parts, *names)


def run(served: Served, model: dict[str, Any], dataset: str, **more: Any) -> dict[str, Any]:
    body = {"model": model, "datasets": [dataset], "algorithm": SMALL, "hold": {"u": "zero"}}
    _, (name,) = identified(served.parts, {**body, **more})
    document: dict[str, Any] = served.server.get(f"/v1/runs/{name}").json()
    assert document["state"] == "succeeded", document["error"]
    return document


def values(document: dict[str, Any]) -> list[float]:
    return [one["value"] for one in document["parameters"]]


def notes(served: Served, *documents: dict[str, Any]) -> list[str]:
    body = {"runs": [one["id"] for one in documents]}
    told = served.server.post("/v1/runs:compare", json=body).json()["notes"]
    return [text for text in told if "different losses" in text]


def test_a_tank_has_generalised_least_squares_unless_squares_are_asked_for(served: Served) -> None:
    auto, white, ar1 = (
        run(served, TANK, served.tank, **({} if name is None else {"loss": {"noise_model": name}}))
        for name in (None, "white", "ar1")
    )
    assert [one["noise_model"] for one in (auto, white, ar1)] == ["ar1", "white", "ar1"]
    assert values(auto) == values(ar1) != values(white)
    assert sum("use loss: {noise_model: white}" in text for text in auto["warnings"]) == 1
    assert notes(served, auto, white)
    assert not notes(served, auto, ar1)
    faults = refused(
        served.server.post(f"/v1/runs/{auto['id']}:profile", json={"parameters": ["K"]}),
        422,
        "invalid",
    )
    assert faults[0]["pointer"] == "/loss/noise_model"


def test_a_lag_has_squares_which_are_profiled_and_compared_as_such(served: Served) -> None:
    auto = run(served, LAG, served.lag)
    white = run(served, LAG, served.lag, loss={"noise_model": "white"})
    assert auto["noise_model"] == white["noise_model"] == "white"
    assert auto["reused_from"] is None
    assert values(auto) == values(white)
    assert auto["warnings"] == white["warnings"]
    assert not notes(served, auto, white)
    path, body = f"/v1/runs/{auto['id']}:profile", {"parameters": ["K"], "points": 5}
    assert served.server.post(path, json=body).status_code == 200


def test_predictions_and_robust_losses_need_no_noise_model_named(served: Served) -> None:
    robust = run(served, TANK, served.tank, loss={"kind": "soft-l1", "scale": 1.0})
    ahead = run(served, TANK, served.tank, prediction="one-step")
    assert robust["noise_model"] == ahead["noise_model"] == "white"


def trend_notes(served: Served, datasets: list[str], **more: Any) -> list[str]:
    labels = [{"level": k + 1} for k in range(len(datasets))]
    axis = {"path": "/datasets", "values": [[one] for one in datasets], "labels": labels}
    body = {"model": TANK, "algorithm": SMALL, "hold": {"u": "zero"}, "sweep": {"axes": [axis]}}
    job, _ = identified(
        served.parts, {**body, "datasets": datasets[:1], "trend": {"x": "level"}, **more}
    )
    told: list[str] = served.server.get(f"/v1/jobs/{job}/trend").json()["notes"]
    return told


def test_a_trend_tells_which_of_its_runs_are_of_another_noise_model(served: Served) -> None:
    (note,) = trend_notes(served, [served.tank, served.quiet])
    assert "estimates of level = 1 use the noise model ar1, others use least squares" in note
    assert "loss: {noise_model: white}" in note
    assert not trend_notes(served, [served.tank, served.quiet], loss={"noise_model": "white"})
    assert not trend_notes(served, [served.tank])
