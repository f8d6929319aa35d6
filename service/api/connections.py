"""HTTP connections of the web process: how many there may be, and how long a head may take.

Whoever opens a connection and sends nothing costs a descriptor, and without descriptors a process
serves nobody. So a connection must send the head of a request in time. If there are as many as
allowed, the one that has waited longest without a request makes room for a new one. Only where each
of them has a request is a new one refused. The time limit is that of Apache's `mod_reqtimeout`.
"""

import asyncio
import json
import logging
import resource
import time
from functools import partial
from typing import Any

from uvicorn import Config
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.core.errors import ServiceBusy

_log = logging.getLogger(__name__)

HEAD_SECONDS = 20.0
"""Time for the head of a request, from the connection or from its first byte."""
RESERVED_FILES = 128
"""Descriptors that are not for connections: database, objects, children, uploads."""
LINGER_SECONDS = 2.0
"""How long a refused connection may take to read its answer."""
MAX_LINGERING = 32
"""Refused connections that may read their answer at once; further ones are cut."""
TELL_SECONDS = 60.0
"""Pause between two lines of the log about the same trouble."""
ACCEPT_TROUBLE = "socket.accept() out of system resource"
"""How asyncio calls an error of `accept`; it tells of one many times a second."""


class RareLog:
    """Tells of one trouble once in `TELL_SECONDS`, with how often it was met."""

    def __init__(self) -> None:
        self._count, self._told_at = 0, -TELL_SECONDS

    def tell(self, text: str) -> None:
        """Count the trouble; write the text if it was not written for a while."""
        self._count += 1
        if time.monotonic() - self._told_at >= TELL_SECONDS:
            _log.warning("%s (%d times)", text, self._count)
            self._count, self._told_at = 0, time.monotonic()


class ConnectionLimits:
    """What the connections of one server share.

    Parameters
    ----------
    most : int
        Connections that may be open at once.

    Attributes
    ----------
    waiting : dict
        Connections without a request, those that have waited longest first.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self.waiting: dict[HttpConnection, None] = {}
        self.n_lingering = 0
        self.refusals = RareLog()

    def build_refusal(self) -> bytes:
        """Build the answer to a connection for which there is no room."""
        error = ServiceBusy(
            f"{self.most} connections are open, each with a request; at most so many are allowed "
            "(LAGID_MAX_CONNECTIONS, and the limit of open files). Try again."
        )
        return _build_answer(error.status, error.kind, error.title, error.detail, error.headers)


def _build_answer(status: int, kind: str, title: str, detail: str, headers: Any = None) -> bytes:
    document = {"type": f"/problems/{kind}", "title": title, "status": status, "detail": detail}
    body = json.dumps(document).encode()
    lines = [
        f"HTTP/1.1 {status} {title}",
        "Content-Type: application/problem+json",
        f"Content-Length: {len(body)}",
        "Connection: close",
        *(f"{name}: {value}" for name, value in (headers or {}).items()),
    ]
    return "\r\n".join([*lines, "", ""]).encode() + body


class HttpConnection(H11Protocol):
    """A connection that must send each head in time, and makes room while it has no request."""

    def __init__(self, *arguments: Any, limits: ConnectionLimits, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._limits = limits
        self._head_timer: asyncio.TimerHandle | None = None
        self._has_begun = self._is_refused = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Take a place, or refuse the connection."""
        super().connection_made(transport)
        if len(self.connections) > self._limits.most and not self._make_room():
            self._refuse()
        else:
            self._wait_for_head()

    def data_received(self, data: bytes) -> None:
        """Receive bytes; a head that has begun must be complete in time."""
        if self._is_refused:
            return
        self._has_begun = True
        super().data_received(data)
        if self._has_request():
            self._end_wait()
        elif self._head_timer is None:
            self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Give the place back."""
        self._end_wait()
        if self._is_refused:
            self._limits.n_lingering -= 1
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        """Wait for the next request; uvicorn limits the time until its first byte."""
        self._has_begun = False
        self._limits.waiting[self] = None
        super().on_response_complete()
        if self._has_request():  # it was there already
            self._end_wait()

    def _has_request(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _wait_for_head(self) -> None:
        self._limits.waiting[self] = None
        self._head_timer = self.loop.call_later(HEAD_SECONDS, self._end_late_head)

    def _end_wait(self) -> None:
        self._limits.waiting.pop(self, None)
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _end_late_head(self) -> None:
        """Close a connection whose head is late; tell it only if a head has begun."""
        self._head_timer = None
        if self._has_begun and not self.transport.is_closing():
            detail = f"the head of the request did not arrive within {HEAD_SECONDS:g} s"
            self.transport.write(
                _build_answer(408, "stalled", "The request did not arrive", detail)
            )
        self.transport.close()

    def _make_room(self) -> bool:
        """Close the connection that has waited longest for a request; False if all have one."""
        oldest = next(iter(self._limits.waiting), None)
        if oldest is None:
            return False
        oldest._end_wait()
        self.connections.discard(oldest)  # its end comes a moment later
        oldest.transport.abort()
        return True

    def _refuse(self) -> None:
        """Answer that there is no room; what the client sends is read, so that it sees that."""
        self._is_refused = True
        self.connections.discard(self)
        self._limits.n_lingering += 1
        self._limits.refusals.tell(f"refused a connection: {self._limits.most} have a request")
        if self._limits.n_lingering > MAX_LINGERING:
            self.transport.abort()
            return
        self.transport.write(self._limits.build_refusal())
        self.transport.write_eof()
        self.loop.call_later(LINGER_SECONDS, self.transport.close)


def limit_connections(config: Config, wanted: int) -> None:
    """Let the server of this configuration have at most so many connections."""
    limits = ConnectionLimits(min(wanted, max(1, _raise_file_limit() - RESERVED_FILES)))
    config.http = partial(HttpConnection, limits=limits)  # type: ignore[assignment]


def _raise_file_limit() -> int:
    """Raise the soft limit of open files to the hard one; return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        except (ValueError, OSError):  # macOS has a limit below the one it tells
            return soft
    return 2**31 if hard == resource.RLIM_INFINITY else hard


def tell_accept_errors_seldom(loop: asyncio.AbstractEventLoop) -> None:
    """Let a loop without descriptors write a line a minute instead of thousands a second."""
    seldom = RareLog()

    def handle(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        if context.get("message") == ACCEPT_TROUBLE:
            seldom.tell(f"no connection can be accepted: {context.get('exception')}")
        else:
            loop.default_exception_handler(context)

    loop.set_exception_handler(handle)
