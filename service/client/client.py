"""The light client of the service: httpx only, without NumPy or Ray."""

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, BinaryIO, Self

import httpx

from service.client import calls
from service.client.calls import RestCall
from service.client.methods import SyncFace
from service.client.operations import Operations


class Client(SyncFace, Operations):
    """Synchronous client of the service.

    All methods take and return plain documents with the field names of the REST interface.

    Parameters
    ----------
    url : str, optional
        Address of the server; by default that of LAGID_URL, else this machine.
    key : str, optional
        API key, if the server requires one; by default that of LAGID_API_KEY.
    timeout : float
        Longest time without a byte of an answer, s. For events it is 45 s: the server sends a sign
        of life every 15 s.
    retries : int
        How often a request is repeated after a lost connection, or an answer 429 or 503. Only
        requests that may be sent twice are repeated: those that read or replace, and those with
        an idempotency key, such as the submission of a job. The pause is that of
        ``Retry-After``, 30 s at most. Without this header it is 0.5 s, and doubles each time.
    transport : httpx.BaseTransport, optional
        Replacement of the network transport, for tests.

    Raises
    ------
    ProblemError
        From every method, if the server refuses the request; holds the problem document.
    ServerUnreachable
        From every method, if no server answers.
    NotFinite
        From every method that sends a body, if a number in it is infinite or NaN.
    """

    def __init__(
        self,
        url: str | None = None,
        key: str | None = None,
        *,
        timeout: float = calls.TIMEOUT_SECONDS,
        retries: int = calls.DEFAULT_RETRIES,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        super().__init__(url, retries)
        headers = calls.make_auth_header(calls.choose_key(key))
        self._http = httpx.Client(
            base_url=self.url, headers=headers, timeout=timeout, transport=transport
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def _send_once(self, call: RestCall[Any], stream: bool) -> httpx.Response:
        source = call.content
        file: AbstractContextManager[BinaryIO | bytes | None]
        file = source.open("rb") if isinstance(source, Path) else nullcontext(source)
        with file as content:
            request = self._http.build_request(**call.request(content))
            response = self._http.send(request, stream=stream)
            if not response.is_success:
                response.read()
        return response

    def _pause(self, seconds: float) -> None:
        time.sleep(seconds)

    def _read_pieces(self, response: httpx.Response) -> Iterator[bytes]:
        return response.iter_bytes()

    def _read_lines(self, response: httpx.Response) -> Iterator[str]:
        return response.iter_lines()

    def _read_next(self, parts: Iterator[Any]) -> Any:
        return next(parts, None)

    def _end_stream(self, response: httpx.Response, parts: Any) -> None:
        parts.close()
        response.close()
