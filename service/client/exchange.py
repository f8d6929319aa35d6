"""How a call gets its answer, once for both clients: repeats, pages, pieces of a file.

It leaves input and output to the steps of a client (`service.client.steps`).
"""

from abc import ABC, abstractmethod
from collections.abc import Generator
from dataclasses import replace
from typing import Any, TypeVar

import httpx

from service.client import calls
from service.client.calls import RestCall, ServerUnreachable
from service.client.steps import AnswerItem, Steps

Answer = TypeVar("Answer")

PAGE_SIZE = 500


class Exchange(ABC):
    """What both clients do with a call, by the steps that each has of its own."""

    def __init__(self, url: str | None, retries: int) -> None:
        self.url, self._retries = calls.choose_url(url), retries
        self._has_answered = False

    @abstractmethod
    def _send_once(self, call: RestCall[Any], stream: bool) -> Any:
        """Step: send a request, and read its answer unless it is a stream; a refusal is read."""

    @abstractmethod
    def _pause(self, seconds: float) -> Any:
        """Step: let so much time pass."""

    @abstractmethod
    def _read_pieces(self, response: httpx.Response) -> Any:
        """Return the pieces of a stream, as they come."""

    @abstractmethod
    def _read_lines(self, response: httpx.Response) -> Any:
        """Return the lines of a stream, as they come."""

    @abstractmethod
    def _read_next(self, parts: Any) -> Any:
        """Step: read the next piece or line of a stream; None at its end."""

    @abstractmethod
    def _end_stream(self, response: httpx.Response, parts: Any) -> Any:
        """Step: leave a stream, and give its connection back."""

    def _send(
        self, call: RestCall[Any], stream: bool = False
    ) -> Generator[Any, Any, httpx.Response]:
        pauses = calls.plan_pauses(call, self._retries)
        while True:
            try:
                response = yield self._send_once(call, stream)
            except httpx.TransportError as error:
                pause = next(pauses, None) if self._is_lost(error) else None
                if pause is None:
                    raise ServerUnreachable(self.url, error) from error
            else:
                self._has_answered = True
                pause = calls.choose_pause(response, pauses)
                if pause is None:
                    return calls.raise_for_problem(response)
            yield self._pause(pause)

    def _is_lost(self, error: httpx.TransportError) -> bool:
        """Whether a connection broke, or a server that had answered before is away."""
        if isinstance(error, httpx.ConnectError):
            return self._has_answered
        return not isinstance(error, httpx.TimeoutException)

    def _fetch(self, call: RestCall[Answer], kind: Any = None) -> Steps[Answer]:
        """Give the answer of a kind: `str`, `bytes`, or else a document of JSON."""
        response = yield from self._send(call)
        form = {str: "text", bytes: "content"}.get(kind)
        yield AnswerItem(getattr(response, form) if form else response.json())

    def _iterate(self, call: RestCall[Answer]) -> Steps[Answer]:
        left, position = call.at_most, {"limit": min(call.at_most or PAGE_SIZE, PAGE_SIZE)}
        while True:
            response = yield from self._send(replace(call, params={**call.params, **position}))
            page = response.json()
            items = page["items"][:left]
            yield from map(AnswerItem, items)
            left = None if left is None else left - len(items)
            if page["next"] is None or left == 0:
                return
            position["cursor"] = page["next"]

    def _download(self, call: RestCall[bytes]) -> Steps[bytes]:
        response = yield from self._send(call, stream=True)
        pieces = self._read_pieces(response)
        try:
            while (piece := (yield self._read_next(pieces))) is not None:
                yield AnswerItem(piece)
        except httpx.TransportError as error:
            raise ServerUnreachable(self.url, error) from error
        finally:
            yield self._end_stream(response, pieces)
