"""Methods of the clients: settings, waiting, lists, and one method for each route."""

import asyncio
import inspect
import json
import pickle
import re
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import aclosing
from functools import partial
from typing import Any
from unittest.mock import create_autospec

import httpx
import pytest

from service.api.contract.write_contract import DOCUMENT_FILE
from service.client import documents
from service.client.async_client import AsyncClient
from service.client.calls import ClientError, WaitTimeout, choose_key
from service.client.client import Client
from service.client.rows import Rows
from tests.support.checkout import ROOT
from tests.support.service.web_app import await_in_thread

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


Sent = tuple[str, str, str, bytes]


class Listener:
    """Answers anything, and keeps what it was asked: method, path, query and body."""

    def __init__(self) -> None:
        self.sent: list[Sent] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        url = request.url
        self.sent.append((request.method, url.path, url.query.decode(), request.content))
        return answer_anything(request)

    def take(self) -> list[Sent]:
        sent, self.sent = self.sent, []
        return sent


def list_methods(client: Client | AsyncClient) -> dict[str, Callable[..., Any]]:
    """Public methods that ask the server for something; both forms of a download."""
    named = inspect.getmembers(client, inspect.ismethod)
    methods = {name: one for name, one in named if not name.startswith("_")}
    assert {methods.pop(name).__name__ for name in ("close", "send")} == {"close", "send"}
    methods["download as csv"] = partial(methods["download"], format="csv")
    return methods


def ask_all() -> dict[str, tuple[list[Sent], Any]]:
    """What each method of the synchronous client sends, and its answer."""
    listener = Listener()
    exchanges = {}
    with Client("http://here", transport=httpx.MockTransport(listener)) as client:
        for name, method in list_methods(client).items():
            answer = method(*choose_arguments(method))
            answer = list(answer) if inspect.isgenerator(answer) else answer
            exchanges[name] = (listener.take(), answer)
    return exchanges


def ask_all_awaited() -> dict[str, tuple[list[Sent], Any]]:
    """What each method of the asynchronous client sends, and its answer."""
    listener = Listener()

    async def work() -> dict[str, tuple[list[Sent], Any]]:
        exchanges = {}
        transport = httpx.MockTransport(listener)
        async with AsyncClient("http://here", transport=transport) as client:
            for name, method in list_methods(client).items():
                answer = method(*choose_arguments(method))
                answer = await answer if inspect.isawaitable(answer) else [a async for a in answer]
                exchanges[name] = (listener.take(), answer)
        return exchanges

    exchanges: dict[str, tuple[list[Sent], Any]] = await_in_thread(work)
    return exchanges


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
    sent = [one for requests, _ in ask_all().values() for one in requests]
    assert {(method, path) for method, path, _, _ in sent} == routes


def test_an_operation_sends_the_same_and_answers_the_same_from_both_clients() -> None:
    exchanges = ask_all()
    assert all(len(sent) == 1 for sent, _ in exchanges.values())
    assert exchanges == ask_all_awaited()


def test_both_clients_show_what_an_operation_takes_and_gives() -> None:
    for name in ("job", "jobs", "wait", "iterate_runs", "runs"):
        assert inspect.getdoc(getattr(Client, name)) == inspect.getdoc(getattr(AsyncClient, name))
    for name in ("job", "jobs", "wait"):
        waiting, twin = getattr(Client, name), getattr(AsyncClient, name)
        assert inspect.signature(waiting) == inspect.signature(twin)
        assert inspect.getdoc(waiting) == inspect.getdoc(twin) is not None
        assert (waiting.__name__, inspect.iscoroutinefunction(twin)) == (name, True)
    for name, answers in (("iterate_jobs", "Iterator"), ("events", "Iterator"), ("runs", "Rows")):
        waiting, twin = getattr(Client, name), getattr(AsyncClient, name)
        assert f".{answers}[" in str(inspect.signature(waiting).return_annotation)
        assert ".AsyncIterator[" in str(inspect.signature(twin).return_annotation)


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
        await_in_thread(work)


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


class Pieces(httpx.SyncByteStream):
    """Five pieces of a file; notes how many were read, and whether the stream was closed."""

    read, is_closed = 0, False

    def __iter__(self) -> Iterator[bytes]:
        for _ in range(5):
            self.read += 1
            yield b"0123456789"

    def close(self) -> None:
        self.is_closed = True


def test_a_download_is_given_piece_by_piece_and_may_be_left() -> None:
    pieces = Pieces()
    transport = httpx.MockTransport(lambda _: httpx.Response(200, stream=pieces))
    with Client("http://here", transport=transport) as client:
        download = client.download_signals("run_1")
        assert next(download) == b"0123456789"
        assert pieces.read < 5
        assert not pieces.is_closed
        del download  # as a loop that is left
        assert pieces.is_closed


def test_a_client_that_waits_works_where_a_loop_runs_as_in_a_notebook() -> None:
    async def work() -> list[Any]:
        pieces = Pieces()
        transport = httpx.MockTransport(
            lambda request: (
                httpx.Response(200, stream=pieces)
                if request.url.path.endswith(".mcap")
                else answer_anything(request)
            )
        )
        with Client("http://here", transport=transport) as client:
            first = next(client.download_signals("run_1"))
            assert pieces.is_closed
            return [first, client.job("x")["id"], *client.iterate_jobs()]

    assert await_in_thread(work) == [b"0123456789", "x"]


def give_pages(request: httpx.Request) -> httpx.Response:
    """Four pages of two numbers each, and a file of five pieces."""
    if request.url.path.endswith(".csv"):
        return httpx.Response(200, stream=Pieces())
    number = int(request.url.params.get("cursor", 0))
    following = str(number + 2) if number < 6 else None
    return httpx.Response(200, json={"items": [number, number + 1], "next": following})


def test_an_iterator_that_was_begun_in_a_loop_goes_on_outside_it() -> None:
    """A loop closes the asynchronous generators that were begun in it, and so loses the rest."""
    with Client("http://here", transport=httpx.MockTransport(give_pages)) as client:
        jobs: Any = client.iterate_jobs()
        pieces = client.download_runs("job_1")

        async def begin() -> list[Any]:
            return [next(jobs), next(pieces)]

        assert await_in_thread(begin) == [0, b"0123456789"]
        assert list(jobs) == [1, 2, 3, 4, 5, 6, 7]
        assert b"".join(pieces) == b"0123456789" * 4


def give_stream(request: httpx.Request) -> httpx.Response:
    """Events without an end, or a file: as long streams, which are left early."""
    is_event = request.url.path.endswith("/events")
    return httpx.Response(200, stream=EndlessStream(b"id: 1\ndata: {}\n\n" if is_event else b"x"))


class EndlessStream(httpx.SyncByteStream, httpx.AsyncByteStream):
    """The same piece again and again."""

    open = 0

    def __init__(self, piece: bytes) -> None:
        self._piece = piece
        EndlessStream.open += 1

    def __iter__(self) -> Iterator[bytes]:
        while True:
            yield self._piece

    async def __aiter__(self) -> AsyncIterator[bytes]:
        while True:
            yield self._piece

    def close(self) -> None:
        EndlessStream.open -= 1

    async def aclose(self) -> None:
        self.close()


STREAMS = ("download", "download_runs", "events")


def test_a_stream_of_the_synchronous_client_that_is_left_leaves_nothing_in_a_loop() -> None:
    async def work() -> None:
        begun: list[Any] = []
        sys.set_asyncgen_hooks(firstiter=begun.append)
        with Client("http://here", transport=httpx.MockTransport(give_stream)) as client:
            for name in STREAMS:
                for _ in getattr(client, name)("x"):
                    break
                assert EndlessStream.open == 0
        assert begun == []
        await asyncio.sleep(0)
        assert asyncio.all_tasks() == {asyncio.current_task()}

    await_in_thread(work)


def test_a_stream_of_the_asynchronous_client_that_is_left_leaves_no_task() -> None:
    async def work() -> None:
        transport = httpx.MockTransport(give_stream)
        async with AsyncClient("http://here", transport=transport) as client:
            for name in STREAMS:
                async with aclosing(getattr(client, name)("x")) as stream:
                    async for _ in stream:
                        break
                assert EndlessStream.open == 0
                for _ in range(20):  # the loop ends generators of httpx, one inside the other
                    await asyncio.sleep(0)
                assert asyncio.all_tasks() == {asyncio.current_task()}

    await_in_thread(work)


def test_a_cancelled_download_ends_its_stream() -> None:
    class Silence(EndlessStream):
        async def __aiter__(self) -> AsyncIterator[bytes]:
            yield b"x"
            await asyncio.Event().wait()

    async def work() -> None:
        transport = httpx.MockTransport(lambda _: httpx.Response(200, stream=Silence(b"")))
        async with AsyncClient("http://here", transport=transport) as client:
            pieces = client.download("ds_1")
            assert await anext(pieces) == b"x"
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(anext(pieces), 0.01)
            assert EndlessStream.open == 0

    await_in_thread(work)


def test_an_error_at_the_caller_ends_the_stream() -> None:
    with Client("http://here", transport=httpx.MockTransport(give_stream)) as client:
        events: Any = client.events("job_1")
        next(events)
        with pytest.raises(KeyError, match="mine"):
            events.throw(KeyError("mine"))
    assert EndlessStream.open == 0


def test_a_mock_of_a_client_has_its_methods() -> None:
    mock = create_autospec(Client, instance=True)
    mock.job("x")
    mock.job.assert_called_once_with("x")
    with pytest.raises(TypeError, match="unknown"):
        mock.job("x", unknown=1)


@pytest.mark.parametrize("face", [Client, AsyncClient])
def test_a_class_of_a_client_has_a_function_of_its_own_for_each_method(face: type) -> None:
    names = [name for name in dir(face) if not name.startswith("_")]
    for name in names:
        function = vars(face)[name]
        assert inspect.isfunction(function)
        assert (function.__qualname__, function.__module__) == (
            f"{face.__name__}.{name}",
            face.__module__,
        )
        assert function.__doc__


def test_a_client_of_ones_own_may_replace_a_method() -> None:
    class Mine(Client):
        def job(self, name: str) -> Any:
            return super().job(name)["id"]

    with Mine("http://here", transport=httpx.MockTransport(answer_anything)) as client:
        assert client.job("x") == "x"


def test_types_of_answers_are_those_of_the_stub_and_stay_the_same() -> None:
    assert documents.JobDocument is documents.JobDocument
    assert pickle.loads(pickle.dumps(documents.JobDocument)) is documents.JobDocument
    assert not hasattr(documents, "NoSuchDocument")


@pytest.mark.parametrize("name", ["job", "datasets", "iterate_datasets", "download", "events"])
@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_arguments_that_do_not_fit_are_told_by_the_name_of_the_method(kind: Any, name: str) -> None:
    method: Any = getattr(kind("http://here"), name)
    told = rf"^{kind.__name__}\.{name}\(\) too many positional arguments$"
    with pytest.raises(TypeError, match=told):
        await_in_thread(lambda: method(1, 2, 3))


def test_an_argument_that_is_missing_is_told_by_the_name_of_the_method() -> None:
    job: Any = Client("http://here").job
    with pytest.raises(TypeError, match=r"^Client\.job\(\) missing a required argument: 'name'$"):
        job()


def test_another_format_of_a_download_is_refused() -> None:
    client: Any = Client("http://here")
    with pytest.raises(ClientError, match="format: found 'xlsx'; need mcap or csv"):
        client.download("ds_1", format="xlsx")


@pytest.mark.parametrize("url", ["127.0.0.1:8123", "localhost:8123/", "ftp://127.0.0.1:8123"])
def test_an_address_without_its_scheme_is_told_how_it_is_written(url: str) -> None:
    host = url.removeprefix("ftp://").rstrip("/")
    with pytest.raises(ClientError, match=f"write http://{host}$"):
        Client(url)


def test_a_file_that_is_not_there_is_told() -> None:
    with pytest.raises(FileNotFoundError, match=r"^there is no file nofile\.csv$"):
        Client("http://here").add_dataset("nofile.csv")
