"""The clients send a call again that a server could not serve just then, and only such a call."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from types import SimpleNamespace
from typing import Any

import httpx
import pytest

from service.client import async_client, calls
from service.client import client as synchronous
from service.client.async_client import AsyncClient
from service.client.calls import ProblemError, ServerUnreachable
from service.client.client import Client
from tests.support.service.web_app import await_in_thread

JOB = {"id": "job_1", "state": "queued"}
AWAY = httpx.codes.SERVICE_UNAVAILABLE


class ScriptedServer:
    """Answers with these statuses, one after the other, and keeps what it was asked."""

    def __init__(self, *statuses: int, headers: dict[str, str] | None = None) -> None:
        self._statuses, self._headers = list(statuses), headers or {}
        self.asked: list[httpx.Request] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        self.asked.append(request)
        status = self._statuses.pop(0)
        if status == AWAY:
            problem = {"title": "A part of the service is down", "detail": "try again"}
            return httpx.Response(AWAY, headers=self._headers, json=problem)
        return httpx.Response(status, headers=self._headers, json=JOB)


@pytest.fixture
def slept(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Pauses that would have been made."""
    pauses: list[float] = []

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    # In the clients alone: threads of other tests may sleep meanwhile.
    monkeypatch.setattr(synchronous, "time", SimpleNamespace(sleep=pauses.append))
    monkeypatch.setattr(async_client, "asyncio", SimpleNamespace(sleep=sleep))
    return pauses


def synchronously(server: ScriptedServer, name: str, *given: Any, **settings: Any) -> Any:
    with Client("http://here", transport=httpx.MockTransport(server), **settings) as client:
        return getattr(client, name)(*given)


def asynchronously(server: ScriptedServer, name: str, *given: Any, **settings: Any) -> Any:
    async def work() -> Any:
        transport = httpx.MockTransport(server)
        async with AsyncClient("http://here", transport=transport, **settings) as client:
            return await getattr(client, name)(*given)

    return await_in_thread(work)


Asked = Callable[..., Any]
both = pytest.mark.parametrize("asked", [synchronously, asynchronously])


@both
@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("job", ["job_1"]),
        ("accept_reference", ["tube", "run_1"]),
        ("submit", [{}]),
        ("noise_sweep", [{}]),
        ("reidentify", [{}]),
    ],
)
def test_a_call_that_may_be_sent_twice_is_sent_until_it_is_served(
    slept: list[float], asked: Asked, name: str, given: Sequence[Any]
) -> None:
    server = ScriptedServer(AWAY, AWAY, 200)
    assert asked(server, name, *given) == JOB
    assert slept == [0.5, 1.0]
    assert len({request.headers.get("Idempotency-Key") for request in server.asked}) == 1


@both
@pytest.mark.parametrize(
    ("name", "given"),
    [("clone", ["job_1"]), ("simulate_dataset", [{}]), ("add_dataset", [b"t,u,y\n"])],
)
def test_a_call_that_might_be_carried_out_twice_is_sent_once(
    slept: list[float], asked: Asked, name: str, given: Sequence[Any]
) -> None:
    server = ScriptedServer(AWAY, 200)
    with pytest.raises(ProblemError, match="try again"):
        asked(server, name, *given)
    assert (len(server.asked), slept) == (1, [])


@both
def test_a_job_has_a_key_of_its_own_if_none_is_given(slept: list[float], asked: Asked) -> None:
    server = ScriptedServer(200, 200)
    asked(server, "submit", {})
    asked(server, "submit", {})
    keys = {request.headers["Idempotency-Key"] for request in server.asked}
    assert len(keys) == 2
    assert all(len(key) >= 32 for key in keys)


@both
@pytest.mark.parametrize(("retries", "pauses"), [(4, [0.5, 1.0, 2.0, 4.0]), (1, [0.5]), (0, [])])
def test_in_the_end_the_refusal_is_raised(
    slept: list[float], asked: Asked, retries: int, pauses: list[float]
) -> None:
    server = ScriptedServer(*[AWAY] * 9)
    with pytest.raises(ProblemError) as refused:
        asked(server, "job", "job_1", retries=retries)
    assert refused.value.status == AWAY
    assert slept == pauses
    assert len(server.asked) == retries + 1


@pytest.mark.parametrize(
    ("header", "pause"),
    [
        ("2", 2.0),
        ("0", 0.0),
        (" 7 ", 7.0),
        ("soon", 0.5),
        ("-3", 0.5),
        ("Mon, 01 Jan 2024 00:00:00 +99999999999999999999", 0.5),
    ],
)
def test_what_the_server_asks_for_is_waited(slept: list[float], header: str, pause: float) -> None:
    server = ScriptedServer(AWAY, 200, headers={"Retry-After": header})
    assert synchronously(server, "job", "job_1") == JOB
    assert slept == [pause]


def test_a_date_is_waited_for(slept: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    now = datetime(2026, 11, 27, 12, tzinfo=UTC)
    monkeypatch.setattr(calls, "datetime", SimpleNamespace(now=lambda _zone: now))
    for ahead, pause in ((20, 20.0), (-60, 0.0)):
        slept.clear()
        until = format_datetime(now + timedelta(seconds=ahead), usegmt=True)
        synchronously(ScriptedServer(AWAY, 200, headers={"Retry-After": until}), "job", "job_1")
        assert slept == [pause]


def test_nobody_waits_for_a_server_that_is_away_for_long(slept: list[float]) -> None:
    server = ScriptedServer(AWAY, 200, headers={"Retry-After": "3600"})
    with pytest.raises(ProblemError):
        synchronously(server, "job", "job_1")
    assert (slept, len(server.asked)) == ([], 1)


@pytest.mark.parametrize("status", [404, 409, 422, 500, 502])
def test_other_refusals_stand(slept: list[float], status: int) -> None:
    server = ScriptedServer(status, 200)
    with pytest.raises(ProblemError):
        synchronously(server, "job", "job_1")
    assert slept == []


def test_events_are_asked_for_again_and_told_from_where_they_broke_off(
    slept: list[float],
) -> None:
    server = ScriptedServer(AWAY, 200)

    def stream(request: httpx.Request) -> httpx.Response:
        answer = server(request)
        text = 'id: 8\nevent: end\ndata: {"state": "failed"}\n\n'
        return answer if answer.is_error else httpx.Response(200, text=text)

    with Client("http://here", transport=httpx.MockTransport(stream)) as client:
        [event] = client.events("job_1", after="7")
    assert event == {"id": "8", "event": "end", "data": {"state": "failed"}}
    assert [one.headers["Last-Event-ID"] for one in server.asked] == ["7", "7"]

    async def work() -> list[Any]:
        transport = httpx.MockTransport(stream)
        async with AsyncClient("http://here", transport=transport) as client:
            return [event async for event in client.events("job_1")]

    server = ScriptedServer(AWAY, 200)
    assert await_in_thread(work) == [event]


def test_events_of_a_server_that_is_not_there() -> None:
    with pytest.raises(ServerUnreachable), Client("http://127.0.0.1:1") as client:
        list(client.events("job_1"))


@both
def test_a_full_queue_is_waited_for_as_long_as_the_server_asks(
    slept: list[float], asked: Asked
) -> None:
    server = ScriptedServer(429, 200, headers={"Retry-After": "10"})
    assert asked(server, "submit", {}) == JOB
    assert slept == [10.0]


class BreakingServer(ScriptedServer):
    """A server that breaks as many connections as there are errors, and then answers."""

    def __init__(self, *errors: type[httpx.TransportError], first: bool = False) -> None:
        super().__init__(*[200] * 9)
        self._errors, self._answers_first = list(errors), first

    def __call__(self, request: httpx.Request) -> httpx.Response:
        if self._answers_first:
            self._answers_first = False
        elif self._errors:
            self.asked.append(request)
            raise self._errors.pop(0)("broken", request=request)
        return super().__call__(request)


@both
def test_a_broken_connection_is_made_again(slept: list[float], asked: Asked) -> None:
    server = BreakingServer(httpx.ReadError, httpx.RemoteProtocolError)
    assert asked(server, "submit", {}) == JOB
    assert slept == [0.5, 1.0]
    assert len({request.headers["Idempotency-Key"] for request in server.asked}) == 1


@both
def test_a_change_without_a_key_is_not_sent_again_over_a_broken_connection(
    slept: list[float], asked: Asked
) -> None:
    server = BreakingServer(httpx.ReadError)
    with pytest.raises(ServerUnreachable):
        asked(server, "cancel", "job_1")
    assert (len(server.asked), slept) == (1, [])


@both
@pytest.mark.parametrize("error", [httpx.ConnectError, httpx.ReadTimeout])
def test_a_server_that_was_never_there_or_takes_too_long_is_not_asked_again(
    slept: list[float], asked: Asked, error: type[httpx.TransportError]
) -> None:
    with pytest.raises(ServerUnreachable):
        asked(BreakingServer(error), "job", "job_1")
    assert slept == []


def test_a_server_that_restarts_is_waited_for(slept: list[float]) -> None:
    server = BreakingServer(httpx.ConnectError, httpx.ConnectError, first=True)
    with Client("http://here", transport=httpx.MockTransport(server)) as client:
        assert client.job("job_1") == client.job("job_1") == JOB
    assert slept == [0.5, 1.0]


def _stream_events(request: httpx.Request) -> httpx.Response:
    """Three streams: the first two break after an event each, the third has the end."""
    last = int(request.headers.get("Last-Event-ID", "0"))
    kind = "end" if last == 2 else "state"
    text = f"id: {last + 1}\nevent: {kind}\ndata: {{}}\n\nid: 9\nevent: half"
    return httpx.Response(200, text=text)


def test_events_go_on_where_a_stream_broke(slept: list[float]) -> None:
    with Client("http://here", transport=httpx.MockTransport(_stream_events)) as client:
        assert [event["id"] for event in client.events("job_1")] == ["1", "2", "3"]

    async def work() -> list[Any]:
        transport = httpx.MockTransport(_stream_events)
        async with AsyncClient("http://here", transport=transport) as client:
            return [event["id"] async for event in client.events("job_1")]

    assert await_in_thread(work) == ["1", "2", "3"]
    assert slept == [0.5] * 4


def test_a_stream_that_always_ends_early_is_given_up(slept: list[float]) -> None:
    transport = httpx.MockTransport(lambda _: httpx.Response(200, text=": nothing\n\n"))
    with Client("http://here", transport=transport, retries=2) as client:
        assert list(client.events("job_1")) == []
    assert slept == [0.5] * 2
