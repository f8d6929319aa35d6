"""The light client of the service: httpx only, without NumPy or Ray.

All methods take and return plain documents with the names of the REST interface.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from types import TracebackType
from typing import Any, Self

import httpx

from service.client import calls
from service.client.async_client import AsyncClient
from service.client.calls import (
    DEFAULT_URL,
    POLL_S,
    RETRIES,
    TERMINAL,
    Call,
    ClientError,
    Document,
    NotFinite,
    ProblemError,
    ServerUnreachable,
    options,
    pause_after,
    pauses,
)
from service.client.methods import Methods

__all__ = ["AsyncClient", "Client", "ClientError", "NotFinite", "ProblemError", "ServerUnreachable"]


class Client(Methods[Document, list[Document], str, bytes]):
    """The service from a program.

    Parameters
    ----------
    url : str
        Address of the server.
    key : str, optional
        API key, where the server asks for one.
    retries : int
        So often a request is sent again that the server could not serve just then (503), if it
        may be sent twice: one that reads or replaces, or has an idempotency key, as those have
        that queue a job. Pauses are what ``Retry-After`` asks for, 30 s at most; without one 0.5 s
        and twice as long each time.
    transport : httpx.BaseTransport, optional
        Another way to the server, for tests.

    Raises
    ------
    ProblemError
        From every method, if the server refuses; it carries the problem document.
    ServerUnreachable
        From every method, if no server answers.
    NotFinite
        From every method that sends a body, if a number in it is infinite or not a number.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        key: str | None = None,
        *,
        retries: int = RETRIES,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self.url, self._retries = url.rstrip("/"), retries
        self._http = httpx.Client(**options(self.url, key), transport=transport)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def send(self, call: Call, *, stream: bool = False) -> httpx.Response:
        """Send one call; errors are raised. A stream is read and closed by the caller."""
        left = pauses(call, self._retries)
        while True:
            answer = self._answer(call, stream)
            pause = pause_after(answer, left)
            if pause is None:
                return calls.checked(answer)
            time.sleep(pause)

    def _answer(self, call: Call, stream: bool) -> httpx.Response:
        with calls.unreachable_told(self.url), calls.opened(call.content) as content:
            request = self._http.build_request(**calls.request(call, content, stream=stream))
            answer = self._http.send(request, stream=stream)
            if not answer.is_success:
                answer.read()
            return answer

    def _one(self, call: Call) -> Document:
        document: Document = self.send(call).json()
        return document

    def _text(self, call: Call) -> str:
        return self.send(call).text

    def _content(self, call: Call) -> bytes:
        return self.send(call).content

    def _all(self, *parts: str, at_most: int | None = None, **filters: Any) -> list[Document]:
        pages = calls.Pages(parts, at_most, filters)
        items: list[Document] = []
        while (call := pages.next()) is not None:
            items += pages.take(self._one(call))
        return items

    def wait(
        self,
        job: str,
        progress: Callable[[Document], object] | None = None,
        *,
        poll: float = POLL_S,
    ) -> Document:
        """Wait until a job has ended; `progress` hears its state at every look."""
        while True:
            state = self.job(job)
            if progress is not None:
                progress(state)
            if state["state"] in TERMINAL:
                return state
            time.sleep(poll)

    def events(self, job: str, after: str | None = None) -> Iterator[Document]:
        """Events of a job as they come, until its end; `after` is the id of the last one known."""
        parser = calls.EventParser()
        with closing(self.send(calls.events(job, after), stream=True)) as stream:
            for line in stream.iter_lines():
                yield from parser.feed(line)

    def runs(self, job: str, *, at_most: int | None = None, **filters: Any) -> list[Document]:
        """All runs of a job, or the first `at_most` that the filters leave."""
        return self._all("jobs", job, "runs", at_most=at_most, **filters)
