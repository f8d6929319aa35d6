"""How a call gets its answer, once for both clients: repeats, pages, pieces of a file.

It is written with ``await``, and leaves input and output to five steps of a client. Those of the
synchronous client never wait.
"""

from abc import ABC, abstractmethod
from collections.abc import AsyncIterator
from dataclasses import replace
from typing import Any, TypeVar

import httpx

from service.client import calls
from service.client.calls import RestCall, ServerUnreachable
from service.client.rows import Rows

Answer = TypeVar("Answer")

PAGE_SIZE = 500


class Exchange(ABC):
    """What both clients do with a call, by the five steps that each has of its own."""

    def __init__(self, url: str | None, retries: int) -> None:
        self.url, self._retries = calls.choose_url(url), retries
        self._has_answered = False

    @abstractmethod
    async def _send_once(self, call: RestCall[Any], stream: bool) -> httpx.Response:
        """Send a request, and read its answer unless it is a stream; a refusal is read."""

    @abstractmethod
    async def _pause(self, seconds: float) -> None:
        """Let so much time pass."""

    @abstractmethod
    def _read_pieces(self, response: httpx.Response) -> AsyncIterator[bytes]:
        """Read a stream piece by piece, as it comes."""

    @abstractmethod
    def _read_lines(self, response: httpx.Response) -> AsyncIterator[str]:
        """Read a stream line by line, as it comes."""

    @abstractmethod
    async def _end_stream(self, response: httpx.Response) -> None:
        """Give the connection of a stream back."""

    async def _send(self, call: RestCall[Any], stream: bool = False) -> httpx.Response:
        pauses = calls.plan_pauses(call, self._retries)
        while True:
            try:
                response = await self._send_once(call, stream)
            except httpx.TransportError as error:
                pause = next(pauses, None) if self._is_lost(error) else None
                if pause is None:
                    raise ServerUnreachable(self.url, error) from error
            else:
                self._has_answered = True
                pause = calls.choose_pause(response, pauses)
                if pause is None:
                    return calls.raise_for_problem(response)
            await self._pause(pause)

    def _is_lost(self, error: httpx.TransportError) -> bool:
        """Whether a connection broke, or a server that had answered before is away."""
        if isinstance(error, httpx.ConnectError):
            return self._has_answered
        return not isinstance(error, httpx.TimeoutException)

    async def _fetch(self, call: RestCall[Answer], kind: Any = None) -> Answer:
        """Return the answer of a kind: `str`, `bytes`, or else a document of JSON."""
        response = await self._send(call)
        form = {str: "text", bytes: "content"}.get(kind)
        answer: Answer = getattr(response, form) if form else response.json()
        return answer

    async def _iterate(self, call: RestCall[Answer]) -> AsyncIterator[Answer]:
        left, position = call.at_most, {"limit": min(call.at_most or PAGE_SIZE, PAGE_SIZE)}
        while True:
            page = (await self._send(replace(call, params={**call.params, **position}))).json()
            items = page["items"][:left]
            for item in items:
                yield item
            left = None if left is None else left - len(items)
            if page["next"] is None or left == 0:
                return
            position["cursor"] = page["next"]

    async def _collect(self, call: RestCall[Answer]) -> Rows[Answer]:
        return Rows([item async for item in self._iterate(call)])

    async def _download(self, call: RestCall[bytes]) -> AsyncIterator[bytes]:
        response = await self._send(call, stream=True)
        try:
            async for piece in self._read_pieces(response):
                yield piece
        except httpx.TransportError as error:
            raise ServerUnreachable(self.url, error) from error
        finally:
            await self._end_stream(response)
