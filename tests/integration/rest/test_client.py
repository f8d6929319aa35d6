"""The light client against the application, without a socket."""

from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.testclient import TestClient

from service.client.async_client import AsyncClient
from service.client.calls import NotFinite, ProblemError, ServerUnreachable, call
from service.client.client import Client
from tests.support.service.web_app import Through, await_in_thread, recording

MANY = {"axes": [{"path": "/seed", "range": [0, 600]}]}


@pytest.fixture
def client(server: TestClient) -> Client:
    return Client("http://testserver", transport=Through(server))


def job_of(dataset: str, **changes: Any) -> dict[str, Any]:
    return {"model": "fopdt", "datasets": [dataset], **changes}


def test_a_file_and_its_bytes_give_the_same_dataset(client: Client, tmp_path: Path) -> None:
    path = tmp_path / "filled.csv"
    path.write_bytes(recording(50))
    stored = client.add_dataset(path)
    assert stored["name"] == "filled"
    assert client.add_dataset(recording(50))["id"] == stored["id"]
    assert client.dataset(stored["id"])["samples"] == 50
    content = client.content(stored["id"])
    assert client.add_dataset(content, "copy")["channels"] == stored["channels"]
    assert {"filled", "copy"} <= {one["name"] for one in client.datasets()}


def test_every_run_of_every_page_is_given(client: Client, dataset: str) -> None:
    job = client.submit(job_of(dataset, sweep=MANY))
    assert [run["number"] for run in client.runs(job["id"])] == list(range(600))
    assert client.jobs(limit=1)[0]["id"] == job["id"]


def test_a_noise_sweep_is_one_job_under_one_key(client: Client, dataset: str) -> None:
    body = {"model": "fopdt", "datasets": [dataset], "sigma": [0, 0.1], "replicates": 2}
    first, again = (client.noise_sweep(body, idempotency_key="noise") for _ in range(2))
    assert first["id"] == again["id"]
    assert [group["runs"] for group in client.summary(first["id"])["groups"]] == [2] * 4


def test_wait_ends_when_the_job_has_and_tells_every_state(client: Client, dataset: str) -> None:
    job = client.submit(job_of(dataset), idempotency_key="wait")
    states: list[str] = []

    def progress(state: dict[str, Any]) -> None:
        states.append(state["state"])
        if len(states) == 1:
            client.cancel(job["id"])

    assert client.wait(job["id"], progress, poll=0.01)["state"] == "cancelled"
    assert states == ["queued", "cancelled"]
    kinds = [event["event"] for event in client.events(job["id"])]
    assert kinds == ["state", "state", "end"]
    assert client.resume(job["id"])["state"] == "queued"
    assert client.clone(job["id"])["id"] != job["id"]


def test_a_problem_has_its_document_and_a_readable_line(client: Client, dataset: str) -> None:
    with pytest.raises(ProblemError, match="did you mean 'fopdt'") as refused:
        client.submit(job_of(dataset, model="fopd"))
    assert refused.value.status == 422
    assert refused.value.document["errors"][0]["pointer"] == "/model"
    assert "\n" not in str(refused.value)


def test_a_dataset_is_downloaded_piece_by_piece(client: Client, dataset: str) -> None:
    assert b"".join(client.download(dataset)) == client.content(dataset)
    text = b"".join(client.download(dataset, "csv")).decode()
    assert text.count("\n") == 1 + client.dataset(dataset)["samples"]
    with pytest.raises(ProblemError, match="no dataset"):
        next(client.download("ds_0"))


def test_models_are_read_checked_and_stored(client: Client) -> None:
    read = client.model("fopdt")
    document, [equation, _] = read["document"], read["equations"]
    assert equation["text"] == "dx/dt = (K*u(t - L) - x)/T"
    assert equation["mathml"].startswith("<math")
    checked = client.check_model(document)
    assert checked["valid"] is True
    assert checked["equations"] == read["equations"]
    assert client.add_model({**document, "name": "own"})["version"] == 1
    listed = {one["name"]: one for one in client.models()}
    assert listed["own"]["equations"] == []


@pytest.mark.parametrize("name", ["a b", "a/b?c#d", "100%", "é:x"])
def test_a_name_in_a_path_is_sent_as_it_is(client: Client, name: str) -> None:
    with pytest.raises(ProblemError) as refused:
        client.model(name)
    assert refused.value.status == 404
    assert call("GET /v1/models/{}", name).path.count("/") == 3


def test_a_server_that_is_not_there_is_said_with_what_to_do() -> None:
    with pytest.raises(ServerUnreachable, match="lagid serve"):
        Client("http://127.0.0.1:1").jobs()


def test_the_asynchronous_client_does_the_same(server: TestClient, dataset: str) -> None:
    async def work() -> None:
        transport = httpx.ASGITransport(server.app)  # type: ignore[arg-type]
        async with AsyncClient("http://testserver", transport=transport) as client:
            stored = await client.add_dataset(recording(), "again")
            assert stored["id"] == dataset
            job = await client.submit(job_of(dataset, sweep=MANY))
            numbers = [run["number"] async for run in client.runs(job["id"])]
            assert numbers == list(range(600))
            await client.cancel(job["id"])
            assert (await client.wait(job["id"]))["state"] == "cancelled"
            with pytest.raises(ProblemError, match="no run"):
                await client.run("run_0")
            pieces = [piece async for piece in client.download(dataset)]
            assert b"".join(pieces) == await client.content(dataset)
            sweep = {"model": "fopdt", "datasets": [dataset], "sigma": [0, 0.1], "replicates": 3}
            twins = [await client.noise_sweep(sweep, idempotency_key="n") for _ in range(2)]
            assert twins[0]["id"] == twins[1]["id"]
            summary = await client.summary(twins[0]["id"], by=["/noise/sigma"])
            assert [group["runs"] for group in summary["groups"]] == [6, 6]

    await_in_thread(work)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_number_that_json_cannot_tell_is_named_and_not_sent(
    client: Client, dataset: str, value: float
) -> None:
    bounds = {"L": {"upper": value}}
    with pytest.raises(NotFinite, match=r"^/parameters/L/upper: found -?(nan|inf); need a finite"):
        client.submit(job_of(dataset, parameters=bounds))
    with pytest.raises(NotFinite, match=r"^/0/noise/sigma: "):
        call("POST /v1/x", json=[{"noise": {"sigma": value}}])
