"""The asynchronous twin of the client; `service.client.client` gives both."""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import aclosing
from types import TracebackType
from typing import Any, Self, TypeAlias, TypeVar

import httpx

from service.client import calls
from service.client.calls import (
    DEFAULT_URL,
    POLL_S,
    RETRIES,
    TERMINAL,
    Call,
    Document,
    options,
    pause_after,
    pauses,
)
from service.client.methods import Methods

Found = TypeVar("Found")
Awaited: TypeAlias = Coroutine[Any, Any, Found]


class AsyncClient(
    Methods[Awaited[Document], Awaited[list[Document]], Awaited[str], Awaited[bytes]]
):
    """The service from an asynchronous program; methods as those of `Client`, with ``await``.

    Parameters and errors are those of `Client`. `runs` and `events` are gone through with
    ``async for``.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        key: str | None = None,
        *,
        retries: int = RETRIES,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self.url, self._retries = url.rstrip("/"), retries
        self._http = httpx.AsyncClient(**options(self.url, key), transport=transport)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def send(self, call: Call, *, stream: bool = False) -> httpx.Response:
        """Send one call; errors are raised. A stream is read and closed by the caller."""
        left = pauses(call, self._retries)
        while True:
            answer = await self._answer(call, stream)
            pause = pause_after(answer, left)
            if pause is None:
                return calls.checked(answer)
            await asyncio.sleep(pause)

    async def _answer(self, call: Call, stream: bool) -> httpx.Response:
        with calls.unreachable_told(self.url):
            content = calls.pieces(call.content)
            request = self._http.build_request(**calls.request(call, content, stream=stream))
            answer = await self._http.send(request, stream=stream)
            if not answer.is_success:
                await answer.aread()
            return answer

    async def _one(self, call: Call) -> Document:
        document: Document = (await self.send(call)).json()
        return document

    async def _text(self, call: Call) -> str:
        return (await self.send(call)).text

    async def _content(self, call: Call) -> bytes:
        return (await self.send(call)).content

    async def _all(self, *parts: str, at_most: int | None = None, **filters: Any) -> list[Document]:
        pages = calls.Pages(parts, at_most, filters)
        items: list[Document] = []
        while (call := pages.next()) is not None:
            items += pages.take(await self._one(call))
        return items

    async def wait(
        self,
        job: str,
        progress: Callable[[Document], object] | None = None,
        *,
        poll: float = POLL_S,
    ) -> Document:
        """Wait until a job has ended; `progress` hears its state at every look."""
        while True:
            state = await self.job(job)
            if progress is not None:
                progress(state)
            if state["state"] in TERMINAL:
                return state
            await asyncio.sleep(poll)

    async def events(self, job: str, after: str | None = None) -> AsyncIterator[Document]:
        """Events of a job as they come, until its end; `after` is the id of the last one known."""
        parser = calls.EventParser()
        stream = await self.send(calls.events(job, after), stream=True)
        async with aclosing(stream):
            async for line in stream.aiter_lines():
                for event in parser.feed(line):
                    yield event

    async def runs(
        self, job: str, *, at_most: int | None = None, **filters: Any
    ) -> AsyncIterator[Document]:
        """Runs of a job, page by page."""
        pages = calls.Pages(("jobs", job, "runs"), at_most, filters)
        while (call := pages.next()) is not None:
            for run in pages.take(await self._one(call)):
                yield run
