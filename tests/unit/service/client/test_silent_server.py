"""A server that falls silent in the middle of an answer does not hold a client for ever."""

import socket
import threading
from collections.abc import Iterator

import pytest

from service.client import calls
from service.client.async_client import AsyncClient
from service.client.calls import Document, ServerUnreachable
from service.client.client import Client
from tests.limits import LIMIT_SECONDS
from tests.rest import awaited

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nTransfer-Encoding: chunked\r\n\r\n"
SILENCE = 0.2


def chunk(text: str) -> bytes:
    return f"{len(text):x}\r\n{text}\r\n".encode()


class SilentServer:
    """Sends each connection the next of some answers, and then nothing; keeps it open."""

    def __init__(self, *answers: bytes) -> None:
        self.asked: list[bytes] = []
        self._answers, self._open = list(answers), list[socket.socket]()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        for answer in self._answers:
            connection, _ = self._listener.accept()
            self.asked.append(connection.recv(65536))
            connection.sendall(answer)
            self._open.append(connection)

    def close(self) -> None:
        self._thread.join(LIMIT_SECONDS)
        for connection in (*self._open, self._listener):
            connection.close()


@pytest.fixture
def silent() -> Iterator[SilentServer]:
    """Sends an event and falls silent; at the next connection the job ends."""
    first = chunk('retry: 1000\n\nid: 1\nevent: state\ndata: {"state": "queued"}\n\n')
    last = chunk('id: 2\nevent: end\ndata: {"state": "succeeded"}\n\n') + chunk("")
    server = SilentServer(HEAD + first, HEAD + last)
    yield server
    server.close()


def read_events(url: str) -> list[Document]:
    with Client(url, timeout=3600.0) as client:
        return list(client.events("job_1"))


def read_events_async(url: str) -> list[Document]:
    async def read() -> list[Document]:
        async with AsyncClient(url, timeout=3600.0) as client:
            return [event async for event in client.events("job_1")]

    events: list[Document] = awaited(read)
    return events


@pytest.mark.parametrize("read", [read_events, read_events_async])
def test_events_go_on_at_a_new_connection(
    silent: SilentServer, monkeypatch: pytest.MonkeyPatch, read: object
) -> None:
    monkeypatch.setattr(calls, "EVENT_TIMEOUT_SECONDS", SILENCE)
    assert callable(read)
    assert [event["id"] for event in read(silent.url)] == ["1", "2"]
    assert b"last-event-id: 1" in silent.asked[1].lower()


def test_a_download_ends_with_an_error() -> None:
    server = SilentServer(HEAD + chunk("half of it"))
    with Client(server.url, timeout=SILENCE) as client:
        pieces = client.download("ds_1")
        assert next(pieces) == b"half of it"
        with pytest.raises(ServerUnreachable):
            next(pieces)
    server.close()
