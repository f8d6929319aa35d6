"""Means of a period and channels that a model does not use, over REST."""

import pytest
from starlette.testclient import TestClient

from tests.support.library.judged_records import FAST, FINE, NOISE, STEP, N, draw_levels, draw_noise
from tests.support.library.judged_records import hold as hold_samples
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import parts_of, store_csv

ALGORITHM = {"population": 24, "generations": 30, "islands": 1}


@pytest.fixture(scope="module")
def dataset(server: TestClient) -> str:
    """A record whose y is a mean, and to which a valve adds."""
    u, valve = draw_levels(1), draw_levels(12)
    fine = FAST.respond(hold_samples(u + 0.4 * (valve - valve[0])))
    y = fine.reshape(N, FINE).mean(axis=1) + NOISE * draw_noise(1)
    rows = [f"{STEP * k:g},{u[k]},{y[k]},{valve[k]}" for k in range(N)]
    return store_csv(server, "\n".join(["t,u,y,valve", *rows, ""]).encode(), "means")


def test_a_job_reads_means_and_sees_a_channel_that_acts(server: TestClient, dataset: str) -> None:
    body = {"model": "fopdt", "datasets": [dataset], "algorithm": ALGORITHM}
    lags = {}
    for hold in ("auto", "mean-after"):
        _, (run,) = identify_job(parts_of(server), {**body, "hold": {"y": hold}, "name": hold})
        found = server.get(f"/v1/runs/{run}").json()
        assert found["state"] == "succeeded", found["error"]
        assert "valve acts as another input" in found["verdict"]["text"]
        lags[hold] = next(p["value"] for p in found["parameters"] if p["name"] == "L")
    assert lags["mean-after"] - lags["auto"] == pytest.approx(0.5 * STEP, abs=0.1)


@pytest.mark.parametrize(
    ("change", "pointer", "detail"),
    [
        ({"hold": {"y": "first"}}, "/hold/y", "need one of auto, mean, mean-after for an output"),
        ({"hold": {"valve": "mean"}}, "/hold/valve", "no input or output 'valve'"),
    ],
)
def test_a_hold_that_cannot_be_is_refused(
    server: TestClient, dataset: str, change: dict[str, object], pointer: str, detail: str
) -> None:
    body = {"model": "fopdt", "datasets": [dataset], "algorithm": ALGORITHM, **change}
    answer = server.post("/v1/jobs", json=body)
    assert answer.status_code == 422
    (error,) = answer.json()["errors"]
    assert error["pointer"] == pointer
    assert detail in error["detail"]


def test_means_that_are_predicted_one_step_ahead_are_refused(
    server: TestClient, dataset: str
) -> None:
    body = {"model": "fopdt", "datasets": [dataset], "algorithm": ALGORITHM, "name": "ahead"}
    body |= {"hold": {"y": "mean"}, "prediction": "one-step"}
    answer = server.post("/v1/jobs", json=body)
    assert answer.status_code == 422
    assert "needs values at the times of the samples" in answer.text
