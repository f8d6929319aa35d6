"""Jobs over REST, without a dispatcher: submitted, listed, controlled, followed."""

from typing import Any

import pytest
from starlette.testclient import TestClient

from service.api import event_feed
from service.core.states import JobState
from service.queue.dispatchers import LEASE_SECONDS_KEY, DispatcherRepository
from service.queue.leases import LeaseQueue
from service.queue.run_writes import RunWriter
from service.repositories.history_rows import HistoryPoint
from service.repositories.model_rows import ModelRepository
from service.storage.tables import Job
from tests.support.service.web_app import parts_of, read_faults, recording, store_csv


def submit(server: TestClient, dataset: str, **changes: Any) -> dict[str, Any]:
    answer = server.post("/v1/jobs", json={"model": "fopdt", "datasets": [dataset], **changes})
    assert answer.status_code == 202, answer.text
    job: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    return job


def list_events(server: TestClient, job: str, **headers: str) -> list[str]:
    answer = server.get(f"/v1/jobs/{job}/events", headers=headers)
    assert answer.status_code in (200, 204)
    return [
        line.removeprefix("event: ")
        for line in answer.text.splitlines()
        if line.startswith("event: ")
    ]


def test_a_job_without_a_dispatcher_is_accepted_and_waits(server: TestClient, dataset: str) -> None:
    unready = server.get("/readyz")
    assert unready.status_code == 503
    assert "A first start compiles the search" in unready.json()["detail"]
    job = submit(server, dataset, name="first")
    read = server.get(f"/v1/jobs/{job['id']}").json()
    assert read["state"] == "queued"
    assert read["name"] == "first"
    assert read["request"]["datasets"] == [dataset]
    assert read["request"]["algorithm"]["bits"] == 24


def test_a_page_says_that_its_job_waits_for_a_dispatcher(server: TestClient, dataset: str) -> None:
    job = submit(server, dataset)["id"]
    page = f"/jobs/{job}"
    assert "This job waits: no dispatcher is alive" in server.get(page).text
    with parts_of(server).database.write_session() as session:
        DispatcherRepository(session).add_dispatcher("one", {LEASE_SECONDS_KEY: 30.0})
    assert "This job waits" not in server.get(page).text
    with parts_of(server).database.write_session() as session:
        DispatcherRepository(session).remove_dispatcher("one")
    server.post(f"/v1/jobs/{job}:cancel")
    assert "This job waits" not in server.get(page).text


def test_a_dataset_may_be_named_instead_of_identified(server: TestClient, dataset: str) -> None:
    job = submit(server, "steps")
    assert server.get(f"/v1/jobs/{job['id']}").json()["request"]["datasets"] == [dataset]


def test_the_same_key_gives_the_same_job_and_another_body_is_refused(
    server: TestClient, dataset: str
) -> None:
    body = {"model": "fopdt", "datasets": [dataset]}
    key = {"Idempotency-Key": "once"}
    first, again = (server.post("/v1/jobs", json=body, headers=key) for _ in range(2))
    assert first.json()["id"] == again.json()["id"]
    other = server.post("/v1/jobs", json={**body, "seed": 9}, headers=key)
    read_faults(other, 422, "invalid")


def test_crossed_axes_give_a_run_for_each_cell_and_zipped_ones_step_together(
    server: TestClient, dataset: str
) -> None:
    axes = [
        {"path": "/seed", "range": [0, 3]},
        {"path": "/noise/sigma", "log": [0.01, 1, 3], "zip": "n"},
        {"path": "/noise/seed", "values": [7, 8, 9], "zip": "n"},
    ]
    job = submit(server, dataset, sweep={"axes": axes})
    assert job["progress"]["runs"] == 9
    runs = server.get(f"/v1/jobs/{job['id']}/runs").json()["items"]
    cells = [tuple(run["cell"].values()) for run in runs]
    assert [cell[0] for cell in cells] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert [cell[2] for cell in cells[:3]] == [7, 8, 9]
    assert abs(cells[1][1] - 0.1) < 1e-12
    assert runs[0]["progress"] == 0.0


def test_the_pages_of_runs_together_are_all_runs_in_order(server: TestClient, dataset: str) -> None:
    job = submit(server, dataset, sweep={"axes": [{"path": "/seed", "range": [0, 7]}]})
    numbers, cursor = [], ""
    while cursor is not None:
        page = server.get(f"/v1/jobs/{job['id']}/runs?limit=3{cursor and f'&cursor={cursor}'}")
        numbers += [run["number"] for run in page.json()["items"]]
        cursor = page.json()["next"]
    assert numbers == list(range(7))
    only = server.get(f"/v1/jobs/{job['id']}/runs", params={"cell": "/seed=4"}).json()["items"]
    assert [run["number"] for run in only] == [4]


def test_labels_of_an_axis_over_datasets_go_to_the_runs(server: TestClient, dataset: str) -> None:
    axis = {
        "path": "/datasets",
        "values": [[dataset], ["steps"]],
        "labels": [{"length_m": 5}, {"length_m": 8}],
    }
    job = submit(server, dataset, sweep={"axes": [axis]})
    runs = server.get(f"/v1/jobs/{job['id']}/runs").json()["items"]
    assert [run["labels"]["length_m"] for run in runs] == [5, 8]
    assert [run["cell"]["/datasets"] for run in runs] == [[dataset], [dataset]]


def test_an_own_model_is_kept_as_it_was_when_the_job_was_submitted(
    server: TestClient, dataset: str
) -> None:
    document = server.get("/v1/models/fopdt").json()["document"]
    first = server.post("/v1/models", json={**document, "name": "mine"})
    assert first.json()["version"] == 1
    job = submit(server, dataset, model="mine")
    changed = {**document, "name": "mine", "title": "changed"}
    assert server.post("/v1/models", json=changed).json()["version"] == 2
    request = server.get(f"/v1/jobs/{job['id']}").json()["request"]
    assert request["model"] == first.json()["document"]
    assert server.get("/v1/models/mine@1").json()["document"] == first.json()["document"]


def test_a_queued_job_is_cancelled_at_once_resumed_and_cloned(
    server: TestClient, dataset: str
) -> None:
    job = submit(server, dataset, seed=5)["id"]
    read_faults(server.post(f"/v1/jobs/{job}:resume"), 409, "conflict")
    assert server.post(f"/v1/jobs/{job}:cancel").json()["state"] == "cancelled"
    assert list_events(server, job) == ["state", "state", "end"]
    assert server.post(f"/v1/jobs/{job}:resume").json()["state"] == "queued"
    read_faults(server.post(f"/v1/jobs/{job}:resume?failed=true"), 409, "conflict")
    twin = server.post(f"/v1/jobs/{job}:clone").json()
    assert twin["id"] != job
    assert server.get(f"/v1/jobs/{twin['id']}").json()["request"]["seed"] == 5


LENGTHS = [{"length_m": 1.0}, {"length_m": 2.0}]
TREND = {
    "trend": {"x": "length_m"},
    "sweep": {"axes": [{"path": "/seed", "values": [1, 2], "labels": LENGTHS}]},
}


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({}, "fopdt on steps"),
        ({"name": None, **TREND}, "fopdt over length [m]"),
        ({"name": "spring", **TREND}, "spring"),
    ],
)
def test_a_job_without_a_name_is_named_by_the_service_and_its_clone_again(
    server: TestClient, dataset: str, fields: dict[str, Any], name: str
) -> None:
    job = submit(server, dataset, **fields)
    assert job["name"] == name
    twin = server.post(f"/v1/jobs/{job['id']}:clone").json()
    assert twin["name"] == name
    requests = [server.get(f"/v1/jobs/{one['id']}").json()["request"] for one in (job, twin)]
    assert [one["name"] for one in requests] == 2 * [fields.get("name")]


def test_events_resume_after_the_last_one_known_and_end_with_the_job(
    own: TestClient,
) -> None:
    answer = own.post(
        "/v1/datasets:simulate",
        json={
            "name": "s",
            "model": "fopdt",
            "parameters": {"K": 2, "T": 1, "L": 0.5, "y0": 0},
            "inputs": {"u": {"kind": "binary", "period": 2}},
            "samples": 300,
            "sample_time": 0.1,
        },
    )
    job = submit(own, answer.json()["id"])["id"]
    parts = parts_of(own)
    with parts.database.write_session() as session:
        claim = LeaseQueue(session).claim_job("test")
        assert claim is not None
    with parts.database.write_session() as session:
        LeaseQueue(session).append_event(claim.lease, "log", {"text": "half way"})
        LeaseQueue(session).finish_job(claim.lease, JobState.FAILED, "no candidate was finite")
    assert list_events(own, job) == ["state", "state", "log", "state", "end"]
    assert list_events(own, job, **{"Last-Event-ID": "3"}) == ["state", "end"]
    assert list_events(own, job, **{"Last-Event-ID": "5"}) == []
    for text in ("x", "-1", "9" * 19, "9" * 30, "9" * 5000):
        answer = own.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": text})
        read_faults(answer, 422, "invalid")
    read = own.get(f"/v1/jobs/{job}").json()
    assert (read["state"], read["error"]) == ("failed", "no candidate was finite")
    read_faults(own.post(f"/v1/jobs/{job}:cancel"), 409, "conflict")


def test_a_stream_is_whole_whatever_is_read_at_once(
    server: TestClient, dataset: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = submit(server, dataset)["id"]
    for _ in range(3):
        assert server.post(f"/v1/jobs/{job}:cancel").status_code == 200
        assert server.post(f"/v1/jobs/{job}:resume").status_code == 202
    server.post(f"/v1/jobs/{job}:cancel")
    whole = list_events(server, job)
    assert whole == ["state", *["state", "end", "state"] * 3, "state", "end"]
    for most in (1, 2, len(whole)):
        monkeypatch.setattr(event_feed, "MAX_BATCH_EVENTS", most)
        assert list_events(server, job) == whole


def test_an_open_stream_ends_when_the_process_is_to_end(own: TestClient) -> None:
    answer = own.post(
        "/v1/datasets:simulate",
        json={
            "name": "s",
            "model": "fopdt",
            "parameters": {"K": 2, "T": 1, "L": 0.5, "y0": 0},
            "inputs": {"u": {"kind": "step"}},
            "samples": 300,
            "sample_time": 0.1,
        },
    )
    job = submit(own, answer.json()["id"])["id"]
    parts = parts_of(own)
    parts.stopping.set()
    assert list_events(own, job) == []  # the stream would not end otherwise: the job is queued


def test_an_axis_over_an_object_gives_each_run_the_whole_object(
    server: TestClient, dataset: str
) -> None:
    values = [{"method": "simple"}, {"bits": 12}]
    job = submit(server, dataset, sweep={"axes": [{"path": "/algorithm", "values": values}]})
    runs = server.get(f"/v1/jobs/{job['id']}/runs").json()["items"]
    found = [run["cell"]["/algorithm"] for run in runs]
    assert [(one["method"], one["bits"]) for one in found] == [("simple", 24), ("improved", 12)]
    axis = {"path": "/parameters/L", "values": [{"upper": 1}, {"upper": 2}]}
    assert submit(server, dataset, sweep={"axes": [axis]})["progress"]["runs"] == 2


def test_a_cancelled_run_keeps_the_best_it_had_found(own: TestClient) -> None:
    job = submit(own, store_csv(own, recording()), parameters={"L": {"upper": 1.0}})["id"]
    parts = parts_of(own)
    (run,) = own.get(f"/v1/jobs/{job}/runs").json()["items"]
    names = own.get(f"/v1/runs/{run['id']}/history").json()["names"]
    assert names == ["K", "T", "L", "y0", "x(0)"]
    with parts.database.write_session() as session:
        lease = LeaseQueue(session).claim_job("d1").lease
        ledger = RunWriter(session, lease)
        ledger.start_runs([run["id"]])
        for number, rms in enumerate((0.5, 0.25)):
            values = [2.0 + number, 1.0, 0.5, 0.0, 0.0]
            point = HistoryPoint(run["id"], 0, number, number, 50 * number, rms, "genetic", values)
            ledger.append_history([point])
        LeaseQueue(session).finish_job(lease, JobState.CANCELLED)
    told = own.get(f"/v1/runs/{run['id']}").json()
    assert told["state"] == "cancelled"
    assert told["rms"] == 0.25
    assert told["evaluations"] == 50
    best = {one["name"]: one for one in told["parameters"]}
    assert best["K"]["value"] == 3.0
    assert best["K"]["stderr"] is None
    assert "cancelled" in best["K"]["reason"]


def test_a_summary_goes_over_the_axes_that_are_no_seeds(server: TestClient, dataset: str) -> None:
    axes = [{"path": "/noise/sigma", "values": [0, 0.1]}, {"path": "/seed", "range": [0, 3]}]
    job = submit(server, dataset, sweep={"axes": axes})["id"]
    told = server.get(f"/v1/jobs/{job}/summary").json()
    assert told["by"] == ["/noise/sigma"]
    assert [(one["key"], one["runs"], one["succeeded"]) for one in told["groups"]] == [
        ({"/noise/sigma": 0}, 3, 0),
        ({"/noise/sigma": 0.1}, 3, 0),
    ]
    by_seed = server.get(f"/v1/jobs/{job}/summary", params={"by": "/seed"}).json()
    assert [one["key"] for one in by_seed["groups"]] == [{"/seed": i} for i in range(3)]


def test_a_summary_over_an_axis_that_is_not_there_names_those_that_are(
    server: TestClient, dataset: str
) -> None:
    job = submit(server, dataset, sweep={"axes": [{"path": "/seed", "range": [0, 3]}]})["id"]
    (fault,) = read_faults(
        server.get(f"/v1/jobs/{job}/summary", params={"by": "/sed"}), 422, "invalid"
    )
    assert fault["pointer"] == "?by"
    assert "no axis or label '/sed'" in fault["detail"]
    assert "/seed" in fault["detail"]


def test_the_start_of_a_later_segment_is_a_parameter_wherever_the_run_is_shown(
    server: TestClient,
) -> None:
    rows = [
        f"{0.1 * k:.1f},{repeat},{k // 7 % 2},{k % 7}" for repeat in (1, 2, 3) for k in range(80)
    ]
    text = "\n".join(["t,repeat,u,y", *rows])
    stored = store_csv(server, text.encode(), segments=["repeat"])
    starts = {"L": {"upper": 2}, "x(0)[3]": {"fixed": 0.9}}
    job = submit(server, stored, parameters=starts)
    (run,) = server.get(f"/v1/jobs/{job['id']}/runs").json()["items"]
    for path in (f"/jobs/{job['id']}", f"/v1/jobs/{job['id']}/report", f"/runs/{run['id']}"):
        assert server.get(path).status_code == 200, path
    drawn = server.get(f"/v1/runs/{run['id']}/figures/convergence")
    assert drawn.status_code == 200
    told = drawn.text
    assert "x(0)[2]" in told
    assert "x(0)[3]" not in told  # it is fixed


def test_the_wall_time_of_a_job_is_null_while_it_waits_and_stands_still_at_its_end(
    own: TestClient,
) -> None:
    dataset = store_csv(own, recording())
    job = submit(own, dataset)
    assert job["seconds"] is None
    parts = parts_of(own)
    with parts.database.write_session() as session:
        claim = LeaseQueue(session).claim_job("test")
        assert claim is not None
    first, second = (own.get(f"/v1/jobs/{job['id']}").json()["seconds"] for _ in range(2))
    assert 0 <= first < second
    with parts.database.write_session() as session:
        LeaseQueue(session).finish_job(claim.lease, JobState.CANCELLED)
    ended, later = (own.get(f"/v1/jobs/{job['id']}").json()["seconds"] for _ in range(2))
    assert second <= ended == later


def test_a_job_whose_model_an_earlier_version_accepted_stays_in_the_lists(
    server: TestClient, dataset: str
) -> None:
    model = {
        "name": "pipe",
        "form": "differential",
        "inputs": {"u": "degC", "q": "m3/h"},
        "states": {"x": "degC"},
        "parameters": {"V": {"lower": 0.1, "upper": 1, "unit": "m3"}},
        "equations": {"x": "u(t - V/q) - x"},  # the lag is in hours, which was read as seconds
        "outputs": {"y": "x"},
        "initial": {"x": 0},
    }
    read_faults(
        server.post("/v1/jobs", json={"model": model, "datasets": [dataset]}),
        422,
        "invalid",
    )
    job = submit(server, dataset)["id"]
    with parts_of(server).database.write_session() as session:
        stored = session.get_one(Job, job)
        stored.spec = {**stored.spec, "model": model}
        ModelRepository(session).add("pipe", model)
    listed = server.get("/v1/jobs").json()["items"]
    assert [entry["rms_unit"] for entry in listed if entry["id"] == job] == ["1"]
    [shown] = [one for one in server.get("/v1/models").json()["items"] if one["name"] == "pipe"]
    assert shown["title"].startswith("refused by this version: ")
    for path in (
        "/",
        "/models",
        "/models/pipe",
        "/v1/models/pipe",
        f"/v1/jobs/{job}",
        f"/v1/jobs/{job}/runs",
    ):
        assert server.get(path).status_code == 200, path
