"""The asynchronous client of the service; the counterpart of `Client`."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Self

import httpx

from service.client import calls
from service.client.calls import RestCall
from service.client.methods import AsyncFace
from service.client.operations import Operations

BLOCK_BYTES = 1 << 20
"""Size of the blocks in which a file is read."""


class AsyncClient(AsyncFace, Operations):
    """Asynchronous client of the service; its methods are those of `Client`, with ``await``.

    Parameters and errors are those of `Client`. `runs` and `events` are iterated with ``async
    for``.
    """

    def __init__(
        self,
        url: str | None = None,
        key: str | None = None,
        *,
        timeout: float = calls.TIMEOUT_SECONDS,
        retries: int = calls.DEFAULT_RETRIES,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        super().__init__(url, retries)
        headers = calls.make_auth_header(calls.choose_key(key))
        self._http = httpx.AsyncClient(
            base_url=self.url, headers=headers, timeout=timeout, transport=transport
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def _send_once(self, call: RestCall[Any], stream: bool) -> httpx.Response:
        content = _read_blocks(call.content) if isinstance(call.content, Path) else call.content
        request = self._http.build_request(**call.request(content))
        response = await self._http.send(request, stream=stream)
        if not response.is_success:
            await response.aread()
        return response

    async def _pause(self, seconds: float) -> None:
        await asyncio.sleep(seconds)

    def _read_pieces(self, response: httpx.Response) -> AsyncIterator[bytes]:
        return response.aiter_bytes()

    def _read_lines(self, response: httpx.Response) -> AsyncIterator[str]:
        return response.aiter_lines()

    async def _read_next(self, parts: AsyncIterator[Any]) -> Any:
        return await anext(parts, None)

    async def _end_stream(self, response: httpx.Response, parts: Any) -> None:
        await parts.aclose()
        await response.aclose()


async def _read_blocks(path: Path) -> AsyncIterator[bytes]:
    with path.open("rb") as file:
        while block := await asyncio.to_thread(file.read, BLOCK_BYTES):
            yield block
