"""A server that falls silent in the middle of an answer does not hold a client for ever."""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest

from service.client import calls
from service.client.async_client import AsyncClient
from service.client.calls import Document, ServerUnreachable
from service.client.client import Client
from tests.support.limits import LIMIT_SECONDS
from tests.support.service.web_app import await_in_thread

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nTransfer-Encoding: chunked\r\n\r\n"
SECOND = b"last-event-id: 1"
SILENCE = 0.2


def chunk(text: str) -> bytes:
    return f"{len(text):x}\r\n{text}\r\n".encode()


class SilentServer:
    """Sends each connection an answer, and then nothing; keeps it open.

    The answer depends on the request alone: on a busy machine a client may ask more often.
    """

    def __init__(self, answer: Callable[[bytes], bytes]) -> None:
        self.asked: list[bytes] = []
        self._answer, self._open = answer, list[socket.socket]()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        with suppress(OSError):  # the end of the listener
            while True:
                connection, _ = self._listener.accept()
                self._open.append(connection)
                self.asked.append(connection.recv(65536))
                with suppress(ConnectionError):  # the client has given up
                    connection.sendall(self._answer(self.asked[-1]))

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join(LIMIT_SECONDS)
        assert not self._thread.is_alive()
        for connection in (*self._open, self._listener):
            connection.close()


@pytest.fixture
def silent() -> Iterator[SilentServer]:
    """Sends an event and falls silent; to who has that one it sends the end of the job."""
    first = chunk('retry: 1000\n\nid: 1\nevent: state\ndata: {"state": "queued"}\n\n')
    last = chunk('id: 2\nevent: end\ndata: {"state": "succeeded"}\n\n') + chunk("")
    server = SilentServer(lambda asked: HEAD + (last if SECOND in asked.lower() else first))
    yield server
    server.close()


def read_events(url: str) -> list[Document]:
    with Client(url, timeout=3600.0) as client:
        return list(client.events("job_1"))


def read_events_async(url: str) -> list[Document]:
    async def read() -> list[Document]:
        async with AsyncClient(url, timeout=3600.0) as client:
            return [event async for event in client.events("job_1")]

    events: list[Document] = await_in_thread(read)
    return events


@pytest.mark.parametrize("read", [read_events, read_events_async])
def test_events_go_on_at_a_new_connection(
    silent: SilentServer, monkeypatch: pytest.MonkeyPatch, read: object
) -> None:
    monkeypatch.setattr(calls, "EVENT_TIMEOUT_SECONDS", SILENCE)
    assert callable(read)
    assert [event["id"] for event in read(silent.url)] == ["1", "2"]
    assert SECOND in silent.asked[-1].lower()


def test_a_download_ends_with_an_error() -> None:
    server = SilentServer(lambda _: HEAD + chunk("half of it"))
    pieces: list[bytes] = []
    patience = SILENCE
    while not pieces:  # on a busy machine the first piece may take longer
        with Client(server.url, timeout=patience) as client, pytest.raises(ServerUnreachable):
            pieces.extend(client.download("ds_1"))
        patience *= 2
    assert pieces == [b"half of it"]
    server.close()
