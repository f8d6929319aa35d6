"""Connections that send nothing, or too slowly, keep nobody out."""

import asyncio
import json
import logging
import resource
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from uvicorn import Config

from service.api import connections
from service.api.app import create_app
from service.api.connections import limit_connections, tell_accept_errors_seldom
from service.core.process.service_metrics import requests
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.web_app import await_in_thread, settings_of
from tests.support.service.web_server import serve_in_thread

MOST = 5


@pytest.fixture
def address(tmp_path: Path) -> Iterator[tuple[str, int]]:
    """A service with few connections."""
    with serve_in_thread(create_app(settings_of(tmp_path)), most_connections=MOST) as url:
        host, _, port = url.removeprefix("http://").partition(":")
        yield host, int(port)


Opener = Callable[..., socket.socket]


@pytest.fixture
def connect(address: tuple[str, int]) -> Iterator[Opener]:
    """Opens a connection and sends the head of a request, or a part of it."""
    with ExitStack() as opened:

        def connect(head: bytes = b"") -> socket.socket:
            connection = opened.enter_context(
                socket.create_connection(address, timeout=LIMIT_SECONDS)
            )
            connection.sendall(head)
            return connection

        yield connect


def read_answer(connection: socket.socket) -> bytes:
    """What comes until the server closes the connection."""
    received = b""
    try:
        while piece := connection.recv(4096):
            received += piece
    except ConnectionResetError:
        pass
    return received


def is_alive(address: tuple[str, int]) -> int:
    return httpx.get("http://{}:{}/healthz".format(*address), timeout=LIMIT_SECONDS).status_code


def test_connections_without_a_request_make_room_the_oldest_first(
    address: tuple[str, int], connect: Opener
) -> None:
    idle = [connect() for _ in range(MOST)]
    for _ in range(2):
        assert is_alive(address) == 200
    assert read_answer(idle[0]) == b""
    idle += [connect(b"GET /healthz HTTP/1.1\r\nHo") for _ in range(3 * MOST)]
    assert is_alive(address) == 200
    for one in idle[: 2 * MOST]:
        assert read_answer(one) == b""
    last = idle[-1]
    last.sendall(b"st: 127.0.0.1\r\nConnection: close\r\n\r\n")
    assert read_answer(last).startswith(b"HTTP/1.1 200")


def test_if_each_connection_has_a_request_the_next_one_is_told_so(
    address: tuple[str, int], connect: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    head = b"POST /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 5\r\n"
    head += b"Content-Type: application/json\r\nConnection: close\r\n\r\n"
    busy = [connect(head) for _ in range(MOST)]
    time.sleep(0.3)  # until the heads are read
    answers = [read_answer(connect(b"GET / HTTP/1.1\r\n")) for _ in range(3)]
    for answer in answers:
        start, _, body = answer.partition(b"\r\n\r\n")
        assert start.startswith(b"HTTP/1.1 503")
        assert b"Retry-After: 2" in start
        assert "LAGID_MAX_CONNECTIONS" in json.loads(body)["detail"]
    assert caplog.text.count("refused a connection") == 1
    for one in busy:
        one.sendall(b"null!")
        assert b" 422 " in read_answer(one).splitlines()[0]
    assert is_alive(address) == 200


def test_the_head_of_each_request_must_come_in_time(
    connect: Opener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "HEAD_SECONDS", 0.3)
    head = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n"
    assert read_answer(connect()) == b""
    assert read_answer(connect(head)).startswith(b"HTTP/1.1 408")
    second = connect(head + b"\r\n")
    answer = b""
    while not answer.endswith(b"}") and (piece := second.recv(4096)):  # it may come in pieces
        answer += piece
    assert answer.startswith(b"HTTP/1.1 200")
    trickling = threading.Thread(target=trickle, args=(second, head))
    trickling.start()
    assert read_answer(second).startswith(b"HTTP/1.1 408")
    trickling.join()


def trickle(connection: socket.socket, head: bytes) -> None:
    try:
        for byte in head:
            connection.sendall(bytes([byte]))
            time.sleep(0.05)
    except OSError:
        pass  # the server has closed it


def test_an_upload_that_is_broken_off_is_no_fault_of_the_server(
    connect: Opener, caplog: pytest.LogCaptureFixture
) -> None:
    def count(status: int) -> float:
        return requests.labels("POST", "/v1/datasets", status)._value.get()

    before = count(499), count(500)
    head = b"POST /v1/datasets HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: text/csv\r\n"
    broken = connect(head + b"Content-Length: 999\r\n\r\nt,u\n")
    time.sleep(0.2)
    broken.close()
    limit = time.monotonic() + LIMIT_SECONDS
    while count(499) == before[0]:
        assert time.monotonic() < limit
        time.sleep(0.02)
    assert count(500) == before[1]
    assert "Traceback" not in caplog.text


def test_there_are_fewer_connections_than_open_files(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = {"now": (256, 1024)}
    monkeypatch.setattr(resource, "getrlimit", lambda _: limits["now"])
    monkeypatch.setattr(resource, "setrlimit", lambda _, new: limits.update(now=new))
    for wanted, most in ((1000, 1024 - connections.RESERVED_FILES), (10, 10)):
        config = Config(create_app)
        limit_connections(config, wanted)
        assert config.http.keywords["limits"].most == most  # type: ignore[union-attr]
    assert limits["now"] == (1024, 1024)


def test_errors_of_accept_are_told_once_a_minute_and_others_as_ever(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def play() -> None:
        loop = asyncio.get_running_loop()
        tell_accept_errors_seldom(loop)
        for _ in range(1000):
            loop.call_exception_handler(
                {"message": connections.ACCEPT_TROUBLE, "exception": OSError("no files")}
            )
        loop.call_exception_handler({"message": "another"})

    with caplog.at_level(logging.WARNING):
        await_in_thread(play)
    assert caplog.text.count("no connection can be accepted: no files (1 times)") == 1
    assert "another" in caplog.text
