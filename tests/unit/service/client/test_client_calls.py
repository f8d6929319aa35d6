"""Methods of the clients: settings, waiting, lists, and one method for each route."""

import inspect
import json
import re
from collections.abc import Callable
from typing import Any

import httpx
import pytest

from service.api.write_contract import DOCUMENT_FILE
from service.client.async_client import AsyncClient
from service.client.calls import ClientError, WaitTimeout, choose_key
from service.client.client import Client
from service.client.rows import Rows
from tests.repository import ROOT
from tests.rest import awaited

# Values of the arguments that a method may need, by the beginning of their annotation.
ARGUMENTS = {"Mapping": {}, "list": [], "str | pathlib.Path": b"t,u\n0,1\n1,2\n", "str": "x"}
VARIABLES = ("LAGID_URL", "LAGID_API_KEY", "LAGID_KEY")


def answer_anything(request: httpx.Request) -> httpx.Response:
    job = {"id": "x", "state": "succeeded", "items": [], "next": None}
    is_stream = request.url.path.endswith("/events")
    return (
        httpx.Response(200, text="id: 1\nevent: end\ndata: {}\n\n")
        if is_stream
        else (httpx.Response(200, json=job))
    )


def list_calls() -> set[tuple[str, str]]:
    """Method and path of what all methods of the client send, with `x` for each name."""
    sent: set[tuple[str, str]] = set()

    def note(request: httpx.Request) -> httpx.Response:
        sent.add((request.method, request.url.path))
        return answer_anything(request)

    with Client("http://here", transport=httpx.MockTransport(note)) as client:
        for name, method in inspect.getmembers(client, inspect.ismethod):
            if name.startswith("_") or name in ("close", "send"):
                continue
            for given in ({}, {"format": "csv"} if name == "download" else {}):
                result = method(*choose_arguments(method), **given)
                if inspect.isgenerator(result):
                    list(result)
    return sent


def choose_arguments(method: Callable[..., Any]) -> list[Any]:
    needed = [
        str(parameter.annotation)
        for parameter in inspect.signature(method).parameters.values()
        if parameter.default is parameter.empty
        and parameter.kind is parameter.POSITIONAL_OR_KEYWORD
    ]
    plain = [text.removeprefix("collections.abc.") for text in needed]
    return [
        next((value for key, value in ARGUMENTS.items() if text.startswith(key)), "x")
        for text in plain
    ]


def test_every_route_has_a_method_and_every_method_a_route() -> None:
    document = json.loads((ROOT / DOCUMENT_FILE).read_text(encoding="utf-8"))
    routes = {
        (verb.upper(), re.sub(r"{\w+}", "x", path))
        for path, verbs in document["paths"].items()
        for verb in verbs
    }
    assert list_calls() == routes


def test_address_and_key_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    asked: list[httpx.Request] = []

    def note(request: httpx.Request) -> httpx.Response:
        asked.append(request)
        return answer_anything(request)

    def ask(*given: str) -> tuple[str, str | None]:
        with Client(*given, transport=httpx.MockTransport(note)) as client:
            client.job("x")
        return client.url, asked[-1].headers.get("Authorization")

    assert ask() == ("http://127.0.0.1:8000", None)
    monkeypatch.setenv("LAGID_URL", "http://there/lagid/")
    monkeypatch.setenv("LAGID_API_KEY", "secret")
    assert ask() == ("http://there/lagid", "Bearer secret")
    assert str(asked[-1].url) == "http://there/lagid/v1/jobs/x"
    assert ask("http://here", "mine") == ("http://here", "Bearer mine")


def test_a_key_loses_its_line_end_and_a_wrong_one_is_not_quoted() -> None:
    assert choose_key("lagid_1_2\n") == "lagid_1_2"
    with pytest.raises(ClientError) as refusal:
        choose_key("lagid_1_\x07secret")
    assert "secret" not in str(refusal.value)


def run_for_ever(_: httpx.Request) -> httpx.Response:
    progress = {"finished": 1, "runs": 3}
    return httpx.Response(200, json={"id": "job_1", "state": "running", "progress": progress})


def test_waiting_ends_in_time_and_the_error_has_the_last_state() -> None:
    with Client("http://here", transport=httpx.MockTransport(run_for_ever)) as client:
        with pytest.raises(WaitTimeout, match=r"job_1 has not ended after 0\.01 s") as ended:
            client.wait("job_1", timeout=0.01, poll=0.001)
        assert ended.value.job["state"] == "running"

    async def work() -> None:
        transport = httpx.MockTransport(run_for_ever)
        async with AsyncClient("http://here", transport=transport) as client:
            await client.wait("job_1", timeout=0.01, poll=0.001)

    with pytest.raises(WaitTimeout):
        awaited(work)


def test_a_bar_on_stderr_shows_the_runs_of_a_job(capsys: pytest.CaptureFixture[str]) -> None:
    transport = httpx.MockTransport(run_for_ever)
    with Client("http://here", transport=transport) as client, pytest.raises(WaitTimeout):
        client.wait("job_1", timeout=0.01, poll=0.001, bar=True)
    shown = capsys.readouterr()
    assert "1/3 runs, running" in shown.err
    assert shown.out == ""


def test_a_page_is_fetched_when_its_first_item_is_wanted() -> None:
    asked: list[str | None] = []

    def give_page(request: httpx.Request) -> httpx.Response:
        cursor = request.url.params.get("cursor")
        asked.append(cursor)
        number = int(cursor or 0)
        return httpx.Response(200, json={"items": [number, number + 1], "next": str(number + 2)})

    with Client("http://here", transport=httpx.MockTransport(give_page)) as client:
        jobs: Any = client.iterate_jobs()
        assert [next(jobs), next(jobs)] == [0, 1]
        assert asked == [None]
        assert next(jobs) == 2
        assert asked == [None, "2"]


@pytest.mark.parametrize("kind", ["datasets", "models", "jobs", "references"])
def test_lists_and_iterators_ask_with_the_same_filters(kind: str) -> None:
    asked = []

    def give_page(request: httpx.Request) -> httpx.Response:
        asked.append((request.url.params.get("name"), request.url.params.get_list("tag")))
        return httpx.Response(200, json={"items": [], "next": None})

    with Client("http://here", transport=httpx.MockTransport(give_page)) as client:
        getattr(client, kind)(name="tube", tag=["a", "b"])
        list(getattr(client, f"iterate_{kind}")(name="tube", tag=["a", "b"]))
    assert asked == [("tube", ["a", "b"])] * 2


def test_a_list_of_runs_becomes_a_table() -> None:
    estimate = {"name": "L", "value": 0.5, "stderr": None, "status": "fixed", "unit": "s"}
    run = {"number": 0, "cell": {"/seed": 1}, "parameters": [estimate], "warnings": ["w"]}
    run["fit_percent"] = {"estimation": 98.0, "validation": None}
    table = Rows([run, {**run, "number": 1}]).to_pandas()
    assert list(table["number"]) == [0, 1]
    assert list(table["L"]) == [0.5, 0.5]
    assert table["L stderr"].isna().all()
    assert table.loc[0, "fit_percent.estimation"] == 98.0
    assert table.loc[0, "cell./seed"] == 1


def test_a_download_is_given_piece_by_piece() -> None:
    class Pieces(httpx.SyncByteStream):
        read = 0

        def __iter__(self) -> Any:
            for _ in range(5):
                self.read += 1
                yield b"0123456789"

    pieces = Pieces()
    transport = httpx.MockTransport(lambda _: httpx.Response(200, stream=pieces))
    with Client("http://here", transport=transport) as client:
        download = client.download_signals("run_1")
        assert next(iter(download)) == b"0123456789"
        assert pieces.read < 5
