"""Values of JSON that no field means are refused with a sentence, never with an error inside."""

import json
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import parts_of, read_faults, recording, settings_of, store_csv

HALF = "\ud800"
SMALL = {"population": 16, "generations": 5, "islands": 1}


def send_body(server: TestClient, path: str, body: Any) -> Any:
    """The answer to a body that the client's own JSON would refuse."""
    return server.post(path, content=json.dumps(body), headers={"content-type": "application/json"})


def test_a_batch_whose_recordings_are_no_names_is_refused(server: TestClient, dataset: str) -> None:
    for given in (0.1, 3, None, {"a": []}, [3], [None], [["x"]], [{}], []):
        axis = {"path": "/datasets", "values": [[dataset], given], "labels": [{"n": 1}, {"n": 2}]}
        body = {"model": "fopdt", "datasets": [dataset], "sweep": {"axes": [axis]}}
        answer = server.post("/v1/jobs", json={**body, "trend": {"x": "n"}})
        faults = read_faults(answer, 422, "invalid")
        assert {one["pointer"] for one in faults} == {"/sweep/axes/0/values/1"}, given


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("/v1/jobs", {"model": "fopdt", "datasets": [HALF]}),
        ("/v1/jobs", {"model": HALF, "datasets": ["steps"]}),
        ("/v1/models", {"name": "own", "title": HALF}),
        (
            "/v1/datasets:simulate",
            {
                "model": "fopdt",
                "parameters": {HALF: 1},
                "samples": 9,
                "sample_time": 1,
                "inputs": {"u": {"kind": "step"}},
            },
        ),
        ("/v1/runs:compare", {"runs": [HALF, "x"]}),
        (
            "/v1/recipes/reidentify",
            {
                "model": HALF,
                "label": "n",
                "trend_parameters": ["L"],
                "batch": [{"x": 1, "datasets": ["steps"]}],
            },
        ),
        (
            "/v1/recipes/reidentify",
            {
                "model": {"name": HALF},
                "label": "n",
                "trend_parameters": ["L"],
                "batch": [{"x": 1, "datasets": ["steps"]}],
            },
        ),
    ],
)
def test_half_of_a_surrogate_pair_is_refused(
    server: TestClient, dataset: str, path: str, body: dict[str, Any]
) -> None:
    answer = send_body(server, path, body)
    assert 400 <= answer.status_code < 500, answer.text
    assert answer.json()["detail"]


@pytest.mark.parametrize("text", [HALF, "a\x00b"])
def test_a_model_that_cannot_be_stored_is_not_called_valid(server: TestClient, text: str) -> None:
    document = server.get("/v1/models/fopdt").json()["document"]
    for changed in ({"title": text}, {text: 1}):
        told = send_body(server, "/v1/models:check", {**document, **changed}).json()
        assert told["valid"] is False
        assert "text contains" in told["errors"][0]["detail"]


def test_a_very_long_value_is_not_repeated_in_full(server: TestClient) -> None:
    body = {"model": "fopdt", "datasets": ["a" * 100_000]}
    answer = server.post("/v1/jobs", json=body)
    [fault] = read_faults(answer, 422, "invalid")
    assert fault["detail"].startswith("there is no dataset 'aaa")
    assert len(answer.content) < 25_000


def test_times_at_the_ends_of_what_doubles_can_hold_are_simulated_or_refused(tmp_path: Any) -> None:
    with TestClient(create_app(settings_of(tmp_path)), raise_server_exceptions=False) as server:
        steps = store_csv(server, recording())
        job = {"model": "fopdt", "datasets": [steps], "algorithm": SMALL}
        _, [run] = identify_job(parts_of(server), job)
        for times, status in (([0, 1e-320], 200), ([1e-320, 2e-320], 200), ([-1e308, 0], 422)):
            series = {"kind": "series", "times": times, "values": [0, 1], "hold": "zero"}
            body = {"inputs": {"u": series}, "samples": 51, "sample_time": 0.1}
            answer = server.post(f"/v1/runs/{run}:simulate", json=body)
            assert answer.status_code == status, answer.text


@pytest.mark.parametrize("path", ["/model", "/parameters/K/fixed"])
def test_of_very_many_wrong_values_some_are_told_and_the_rest_is_not_looked_at(
    server: TestClient, dataset: str, path: str
) -> None:
    wrong = [f"m{n}" if path == "/model" else -100 - n for n in range(3000)]
    axis = {"path": path, "values": wrong}
    body = {"model": "tube", "datasets": [dataset], "sweep": {"axes": [axis]}}
    faults = read_faults(server.post("/v1/jobs", json=body), 422, "invalid")
    assert [one["pointer"] for one in faults[:-1]] == [
        f"/sweep/axes/0/values/{n}" for n in range(200)
    ]
    assert faults[-1] == {
        "pointer": "",
        "detail": "200 faulty axis values are reported. The rest is not checked",
    }
    axis["values"] = [*wrong[:200], 0.5 if path != "/model" else "tube"]
    assert len(read_faults(server.post("/v1/jobs", json=body), 422, "invalid")) <= 201


def test_of_very_many_faults_a_thousand_are_told(server: TestClient, dataset: str) -> None:
    names = {f"p{n}": {"upper": 1} for n in range(5000)}
    body = {"model": "fopdt", "datasets": [dataset], "parameters": names}
    faults = read_faults(server.post("/v1/jobs", json=body), 422, "invalid")
    assert len(faults) == 1002
    assert faults[-1]["detail"] == "more faults follow; they are not listed"


@pytest.mark.parametrize(
    "query",
    [
        {"cursor": f"[null,{'9' * 30}]"},
        {"cursor": "[true,true]"},
        {"cursor": "[null,false]"},
        {"cursor": "[9999999999999999999999,1]", "order": "evaluations"},
        {"cursor": "[1,1.5]"},
        {"cell": f"/seed={'9' * 30}"},
        {"cell": f"/seed={'9' * 5000}"},
        {"cell": "/seed=" + "[" * 20_000},
        {"cell": '/seed="\\ud800"'},
        {"cell": "/seed=NaN"},
        {"cell": "/se\x00ed=1"},
        {"label": f"n={'9' * 30}"},
    ],
    ids=lambda query: next(iter(query.values()))[:20],
)
def test_positions_and_filters_that_no_database_can_compare_are_refused_or_match_nothing(
    server: TestClient, dataset: str, query: dict[str, str]
) -> None:
    body = {"model": "fopdt", "datasets": [dataset]}
    job = server.post("/v1/jobs", json=body).json()["id"]
    answer = server.get(f"/v1/jobs/{job}/runs", params=query)
    if answer.status_code == 200:
        assert answer.json()["items"] == []
    else:
        assert read_faults(answer, 422, "invalid") is not None
        assert len(answer.content) < 7000


def test_a_range_of_5000_digits_ends_with_the_file(server: TestClient, dataset: str) -> None:
    path = f"/v1/datasets/{dataset}/content"
    whole = server.get(path).content
    answer = server.get(path, headers={"Range": f"bytes=0-{'9' * 5000}"})
    assert (answer.status_code, answer.content) == (206, whole)
    read_faults(server.get(path, headers={"Range": f"bytes={'9' * 5000}-"}), 416, "range")
