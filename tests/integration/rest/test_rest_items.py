"""Stored items over REST, client and commands: edited, found, deleted."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.api.app import create_app
from service.client.calls import ProblemError, call
from service.client.client import Client
from tests.support.library.small_models import LINE
from tests.support.service.commands import check_refusal, run_lagid
from tests.support.service.local_runs import identify_job
from tests.support.service.web_app import parts_of, read_faults, recording, settings_of, store_csv
from tests.support.service.web_server import serve_in_thread

FAST = {"population": 10, "generations": 5, "islands": 1, "refine": False}


@pytest.fixture(scope="module")
def done(server: TestClient, dataset: str) -> tuple[str, str]:
    """An ended job and its run."""
    body = {"model": "fopdt", "datasets": [dataset], "algorithm": FAST, "name": "ended"}
    job, (run,) = identify_job(parts_of(server), body)
    return job, run


def submit(server: TestClient, dataset: str, **changes: Any) -> str:
    answer = server.post("/v1/jobs", json={"model": "fopdt", "datasets": [dataset], **changes})
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


def list_names(server: TestClient, path: str, **query: Any) -> list[str]:
    answer = server.get(path, params=query)
    assert answer.status_code == 200, answer.text
    return [item["name"] for item in answer.json()["items"]]


def test_an_edit_answers_the_item_and_its_new_version(server: TestClient, dataset: str) -> None:
    path = f"/v1/jobs/{submit(server, dataset)}"
    first = server.get(path).headers["etag"]
    changed = server.patch(
        path, json={"tags": ["a", "b"], "note": "x"}, headers={"If-Match": first}
    )
    assert changed.status_code == 200, changed.text
    assert (changed.json()["tags"], changed.json()["note"]) == (["a", "b"], "x")
    assert server.get(path).headers["etag"] == changed.headers["etag"] != first
    stale = server.patch(path, json={"name": "new"}, headers={"If-Match": first})
    read_faults(stale, 412, "stale")
    assert server.patch(path, json={"name": "new"}).json()["name"] == "new"  # without If-Match


@pytest.mark.parametrize(
    ("body", "pointer"),
    [
        ({"name": ""}, "/name"),
        ({"name": None}, "/name"),
        ({"name": " a"}, "/name"),
        ({"note": 1}, "/note"),
        ({"tags": ["a\n"]}, "/tags/0"),
        ({"tags": None}, "/tags"),
        ({"tags": ["a"] * 51}, "/tags"),
        ({"state": "failed"}, "/state"),
    ],
)
def test_an_edit_that_makes_no_sense_is_refused_where_it_is(
    server: TestClient, dataset: str, body: dict[str, Any], pointer: str
) -> None:
    faults = read_faults(server.patch(f"/v1/datasets/{dataset}", json=body), 422, "invalid")
    assert [fault["pointer"] for fault in faults] == [pointer]


def test_every_kind_of_item_is_edited_and_read_with_its_version(
    server: TestClient, dataset: str, done: tuple[str, str]
) -> None:
    job, run = done
    assert server.post("/v1/models", json={**LINE, "name": "own"}).status_code == 201
    accepted = server.put("/v1/references/tube", json={"run": run})
    assert accepted.status_code == 200
    for path in (
        f"jobs/{job}",
        f"runs/{run}",
        f"datasets/{dataset}",
        "models/own",
        "references/tube",
    ):
        changed = server.patch(f"/v1/{path}", json={"tags": ["good"], "note": "seen"})
        assert changed.status_code == 200, changed.text
        read = server.get(f"/v1/{path}")
        assert (read.json()["tags"], read.json()["note"]) == (["good"], "seen")
        assert read.headers["etag"] == changed.headers["etag"]
    read_faults(server.patch("/v1/models/fopdt", json={"note": "x"}), 404, "not-found")
    read_faults(server.patch(f"/v1/runs/{run}", json={"name": "x"}), 422, "invalid")
    for path in ("jobs", "datasets", "models", "references"):
        assert len(list_names(server, f"/v1/{path}", tag="good")) == 1
    runs = server.get(f"/v1/jobs/{job}/runs", params={"tag": "good"}).json()["items"]
    assert [one["id"] for one in runs] == [run]
    assert server.get(f"/v1/jobs/{job}/runs", params={"tag": "bad"}).json()["items"] == []


def test_lists_are_filtered_by_all_conditions(server: TestClient) -> None:
    data = store_csv(server, recording(200), "Filter me")
    axis = {"path": "/datasets", "values": [data], "labels": [{"length_m": 5}]}
    for name, more in (("Filtered A", {}), ("filtered b", {"sweep": {"axes": [axis]}})):
        submit(server, data, name=name, **more)
    assert list_names(server, "/v1/jobs", name="FILTERED") == ["filtered b", "Filtered A"]
    assert list_names(server, "/v1/jobs", dataset=data, label="length_m=5.0") == ["filtered b"]
    assert list_names(server, "/v1/jobs", dataset=data, model="fopdt", state="queued", limit=1) == [
        "filtered b"
    ]
    assert list_names(server, "/v1/jobs", dataset=data, state="failed") == []
    assert list_names(server, "/v1/jobs", name="filtered", until="2020-01-01") == []
    assert len(list_names(server, "/v1/jobs", name="filtered", since="2020-01-01T00:00:00Z")) == 2
    assert list_names(server, "/v1/datasets", name="ter M") == ["Filter me"]
    assert "fopdt" in list_names(server, "/v1/models", name="opd")
    assert list_names(server, "/v1/models", name="opd", since="2020-01-01") == []


@pytest.mark.parametrize(
    "query", ["label=x", "label==5", "since=yesterday", "until=1", "dataset=" + "&dataset=" * 11]
)
def test_a_filter_that_makes_no_sense_is_refused(server: TestClient, query: str) -> None:
    answer = server.get(f"/v1/jobs?{query}")
    if query == "until=1":  # seconds since 1970
        assert answer.json()["items"] == []
        return
    read_faults(answer, 422, "invalid")


@pytest.mark.parametrize("moment", ["0001-01-01", "9999-12-31T23:59:59+00:00"])
def test_times_far_away_are_no_fault(server: TestClient, moment: str) -> None:
    for name in ("since", "until"):
        assert server.get("/v1/jobs", params={name: moment}).status_code == 200


def test_the_document_of_the_interface_has_edits_and_deletions(server: TestClient) -> None:
    document = server.get("/openapi.json").json()
    for path in ("jobs/{job_id}", "runs/{run_id}", "datasets/{dataset_id}", "models/{name}"):
        for method in ("patch", "delete"):
            operation = document["paths"][f"/v1/{path}"][method]
            assert {"200", "403", "404", "409", "412", "422", "503"} <= {*operation["responses"]}
    listed = {one["name"] for one in document["paths"]["/v1/jobs"]["get"]["parameters"]}
    assert {"name", "model", "dataset", "tag", "label", "state", "since", "until"} <= listed


def test_what_was_made_from_an_item_is_listed_and_deleted_on_request(own: TestClient) -> None:
    data = store_csv(own, recording())
    derived = own.post(f"/v1/datasets/{data}:derive", json={"steps": [{"trim": {"stop": 20}}]})
    child = derived.json()["id"]
    job, (run,) = identify_job(
        parts_of(own), {"model": "fopdt", "datasets": [child], "algorithm": FAST}
    )
    read_faults(own.delete(f"/v1/datasets/{data}"), 409, "conflict")
    document = own.delete(f"/v1/datasets/{data}").json()
    assert [(one["kind"], one["id"]) for one in document["dependents"]] == [
        ("dataset", child),
        ("job", job),
    ]
    deleted = own.delete(f"/v1/datasets/{data}", params={"cascade": True})
    assert [one["id"] for one in deleted.json()["deleted"]] == [data, child, job]
    for path in (f"datasets/{data}", f"jobs/{job}", f"runs/{run}", f"jobs/{job}/runs"):
        read_faults(own.get(f"/v1/{path}"), 404, "not-found")
    for path in (f"datasets/{data}", f"jobs/{job}", f"runs/{run}"):
        read_faults(own.delete(f"/v1/{path}"), 404, "not-found")  # as what was never there
    again = store_csv(own, recording())
    assert again != data  # the same file may come again
    own.delete(f"/v1/datasets/{again}").raise_for_status()


def test_lineage_names_what_was_deleted(own: TestClient) -> None:
    data = store_csv(own, recording())
    body = {"model": "fopdt", "datasets": [data], "algorithm": FAST, "name": "gone"}
    job, _ = identify_job(parts_of(own), body)
    own.delete(f"/v1/jobs/{job}").raise_for_status()
    lineage = own.get(f"/v1/datasets/{data}/lineage").json()
    assert [(one["parent"], one["child"]) for one in lineage["edges"]] == [(data, job)]
    assert [(one["id"], one["name"]) for one in lineage["deleted"]] == [(job, "gone")]
    page = own.get(f"/datasets/{data}").text
    assert ">job, deleted</text>" in page
    assert "<title>gone</title>" in page
    assert f"/jobs/{job}" not in page  # there is nothing to open


def test_an_open_job_must_be_cancelled_first(server: TestClient, dataset: str) -> None:
    job = submit(server, dataset)
    faults = server.delete(f"/v1/jobs/{job}")
    read_faults(faults, 409, "conflict")
    assert "ancel it" in faults.json()["detail"]
    server.post(f"/v1/jobs/{job}:cancel").raise_for_status()
    version = server.get(f"/v1/jobs/{job}").headers["etag"]
    stale = server.delete(f"/v1/jobs/{job}", headers={"If-Match": '"other"'})
    read_faults(stale, 412, "stale")
    server.delete(f"/v1/jobs/{job}", headers={"If-Match": version}).raise_for_status()
    read_faults(server.delete(f"/v1/jobs/{job}"), 404, "not-found")


@pytest.fixture(scope="module")
def server_client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Client]]:
    app = create_app(settings_of(tmp_path_factory.mktemp("served")))
    with serve_in_thread(app) as url, Client(url) as client:
        yield url, client


def test_the_client_edits_finds_and_deletes(server_client: tuple[str, Client]) -> None:
    _, client = server_client
    data = client.add_dataset(recording(), "steps")["id"]
    job = client.submit({"model": "fopdt", "datasets": [data], "name": "mine"})["id"]
    version = client.send(call("GET /v1/jobs/{}", job)).headers["ETag"]
    assert client.edit_job(job, {"tags": ["x"]}, if_match=version)["tags"] == ["x"]
    with pytest.raises(ProblemError) as stale:
        client.edit_job(job, {"tags": []}, if_match=version)
    assert stale.value.status == 412
    assert [one["id"] for one in client.jobs(tag=["x"], name="min")] == [job]
    assert client.datasets(name="none") == []
    client.cancel(job)
    with pytest.raises(ProblemError) as refusal:
        client.delete_dataset(data)
    assert [one["id"] for one in refusal.value.document["dependents"]] == [job]
    deleted = client.delete_dataset(data, cascade=True)["deleted"]
    assert [one["id"] for one in deleted] == [data, job]


def test_commands_edit_find_and_delete(server_client: tuple[str, Client], tmp_path: Path) -> None:
    url, client = server_client
    client.add_dataset(recording(150), "tube 5")
    job = client.submit({"model": "fopdt", "datasets": ["tube 5"], "name": "five"})["id"]

    def run(*words: str) -> Any:
        return run_lagid(*words, cwd=tmp_path, LAGID_URL=url)

    shown = run("dataset", "edit", "tube 5", "--name", "tube 5 m", "--tag", "night")
    assert shown.stdout.endswith("tube 5 m  [night]\n")
    assert "five" in run("jobs", "--dataset", "tube 5 m", "--state", "queued").stdout
    assert run("jobs", "--name", "none").stdout == "no such jobs\n"
    assert json.loads(run("datasets", "--tag", "night", "--json").stdout)[0]["name"] == "tube 5 m"
    assert json.loads(run("models", "list", "--name", "OPD", "--json").stdout)
    assert run("models", "list", "--tag", "none").stdout == "no models\n"
    assert run("references", "list", "--name", "none").stdout == "no such references\n"
    assert "nothing to change" in check_refusal(run("job", "edit", job), 2)
    assert "--yes" in check_refusal(run("job", "delete", job))
    assert "is queued" in check_refusal(run("job", "delete", job, "--yes"))
    client.cancel(job)
    line = check_refusal(run("dataset", "delete", "tube 5 m", "--yes"))
    assert f"job {job} (five)" in line
    assert "--cascade" in line
    deleted = run("dataset", "delete", "tube 5 m", "--yes", "--cascade").stdout.splitlines()
    assert [text.split("  ")[1] for text in deleted] == ["tube 5 m", "five"]
