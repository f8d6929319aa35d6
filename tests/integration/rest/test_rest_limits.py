"""What a project may have unfinished: beyond it a submission is refused, and can be sent later."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from tests.support.service.web_app import read_faults, recording, settings_of, store_csv


@pytest.fixture
def limited_server(tmp_path: Path) -> Iterator[TestClient]:
    """An application that allows two open jobs and 12 open runs, with a recording in it."""
    settings = settings_of(tmp_path, max_open_jobs=2, max_open_runs=12)
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        store_csv(client, recording())
        yield client


def make_body(runs: int = 1) -> dict[str, Any]:
    sweep = {"axes": [{"path": "/seed", "range": [0, runs]}]}
    return {"model": "fopdt", "datasets": ["steps"], "sweep": sweep}


def read_refusal(server: TestClient, address: str = "/v1/jobs", **request: Any) -> str:
    answer = server.post(address, **request)
    read_faults(answer, 429, "too-much-unfinished")
    assert int(answer.headers["retry-after"]) > 0
    return str(answer.json()["detail"])


def test_a_job_beyond_the_limit_is_refused_leaves_nothing_and_gets_in_later(
    limited_server: TestClient,
) -> None:
    first, second = (
        limited_server.post("/v1/jobs", json=make_body()).json()["id"] for _ in range(2)
    )
    assert "2 jobs of the project are queued or running; at most 2 may" in read_refusal(
        limited_server, json=make_body()
    )
    assert {job["id"] for job in limited_server.get("/v1/jobs").json()["items"]} == {first, second}
    limited_server.post(f"/v1/jobs/{first}:cancel")
    assert limited_server.post("/v1/jobs", json=make_body()).status_code == 202


def test_a_sweep_with_more_runs_than_may_be_open_is_refused_with_the_counts(
    limited_server: TestClient,
) -> None:
    assert limited_server.post("/v1/jobs", json=make_body(10)).status_code == 202
    told = read_refusal(limited_server, json=make_body(3))
    assert "10 runs of the project are not done, and this job adds 3. At most 12" in told
    assert limited_server.post("/v1/jobs", json=make_body(2)).status_code == 202


def test_the_same_key_finds_its_job_also_when_the_project_is_full(
    limited_server: TestClient,
) -> None:
    key = {"Idempotency-Key": "once"}
    first = limited_server.post("/v1/jobs", json=make_body(), headers=key).json()["id"]
    limited_server.post("/v1/jobs", json=make_body())
    assert limited_server.post("/v1/jobs", json=make_body(), headers=key).json()["id"] == first


def test_a_job_cannot_come_back_by_resuming_or_cloning_into_a_full_project(
    limited_server: TestClient,
) -> None:
    gone = limited_server.post("/v1/jobs", json=make_body()).json()["id"]
    limited_server.post(f"/v1/jobs/{gone}:cancel")
    for _ in range(2):
        limited_server.post("/v1/jobs", json=make_body())
    read_refusal(limited_server, f"/v1/jobs/{gone}:resume")
    read_refusal(limited_server, f"/v1/jobs/{gone}:clone")
    assert limited_server.get(f"/v1/jobs/{gone}").json()["state"] == "cancelled"
