"""What holds for every request and answer: who may ask, the size and pace of a body, and headers.

FastAPI reads a whole body before it parses it, so the limits must apply while it is received.
Uploads have a separate limit of their size.
"""

import asyncio
import re
import time
from collections.abc import Mapping

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.requests.problems import error_response
from service.api.requests.request_root_path import get_service_path
from service.core.bodies.text_checks import parse_digits
from service.core.errors import ForeignOrigin, MisdirectedRequest, StalledRequest, TooLarge
from service.core.settings import Settings

UPLOAD_ROUTE = ("POST", "/v1/datasets")
"""The upload goes to a file while it arrives (`service.api.content`)."""


MAX_PAUSE_SECONDS = 60.0
"""Longest pause between two pieces of a body."""
BODY_SECONDS = 20.0
BODY_RATE = 500.0
"""Time for a body, and the bytes that give it a further second: those of Apache's
`mod_reqtimeout`."""


class BodyPace:
    """Middleware that refuses a body whose sender stops, or sends a byte now and then.

    Only the time in which the service waits for the sender counts.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and watch how its body arrives."""
        is_http = scope["type"] == "http"
        await self._app(scope, self._limit_receive(receive) if is_http else receive, send)

    def _limit_receive(self, receive: Receive) -> Receive:
        size, waited, is_complete = 0, 0.0, False

        async def receive_in_time() -> Message:
            nonlocal size, waited, is_complete
            if is_complete:
                return await receive()  # which waits for the end of the connection
            begun = time.monotonic()
            left = max(0.0, BODY_SECONDS + size / BODY_RATE - waited)
            try:
                async with asyncio.timeout(min(left, MAX_PAUSE_SECONDS)):
                    message = await receive()
            except TimeoutError:
                raise StalledRequest(
                    f"{size} bytes of the body came within {waited + left:.0f} s, or nothing for "
                    f"{MAX_PAUSE_SECONDS:g} s. Need {BODY_RATE:g} bytes a second after the first "
                    f"{BODY_SECONDS:g} s"
                ) from None
            waited += time.monotonic() - begun
            size += len(message.get("body", b""))
            is_complete = not message.get("more_body", False)
            return message

        return receive_in_time


class BodyLimit:
    """Middleware that refuses a body of more than `limit` bytes.

    A body that is announced as longer is not read at all. Any other body is read up to the limit.
    """

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app, self._limit = app, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and count the bytes of its body."""
        if scope["type"] != "http" or (scope["method"], get_service_path(scope)) == UPLOAD_ROUTE:
            await self._app(scope, receive, send)
        else:
            await self._app(scope, self._limit_receive(scope, receive), send)

    def _limit_receive(self, scope: Scope, receive: Receive) -> Receive:
        announced = Headers(scope=scope).get("content-length", "")
        size = 0

        async def receive_counted() -> Message:
            nonlocal size
            if announced.isdecimal():
                self._check_size(parse_digits(announced), "")
            message = await receive()
            size += len(message.get("body", b""))
            self._check_size(size, " or more")
            return message

        return receive_counted

    def _check_size(self, size: int, suffix: str) -> None:
        if size > self._limit:
            raise TooLarge(
                f"the body has {size} bytes{suffix}; at most {self._limit} are allowed "
                "(LAGID_MAX_BODY_BYTES)"
            )


SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
FOREIGN_SITES = ("cross-site", "same-site")
_AUTHORITY = re.compile(r"(\[[0-9a-f:.]+\]|[^\s\[\]:/@]+)(:[0-9]{0,5})?")


class OriginCheck:
    """Middleware that refuses requests of web pages that are not the service's own.

    Any page that a user visits can reach a service on loopback. It may use a name of its own that
    resolves to 127.0.0.1 (DNS rebinding), or send a request whose answer it cannot read. So `Host`
    must be a name of the service. A request that changes something must not come from a page of
    another origin. Programs send no `Origin`, and nothing else is asked of them.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app, self._settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it before anything of it is read."""
        if scope["type"] == "http":
            try:
                self._check(scope["method"], Headers(scope=scope))
            except (MisdirectedRequest, ForeignOrigin) as error:
                await error_response(Request(scope), error)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _check(self, method: str, headers: Headers) -> None:
        hosts = headers.getlist("host")  # none in HTTP/1.0, which no browser speaks
        for host in hosts:
            if not self._settings.is_served_host(_parse_name(host)):
                raise MisdirectedRequest(
                    f"the host {host!r} is none of this service's names. Use its address, or add "
                    "the name to LAGID_ALLOWED_HOSTS."
                )
        if method in SAFE_METHODS:
            return
        if headers.get("sec-fetch-site") in FOREIGN_SITES:
            raise ForeignOrigin("a page of another site sent this request")
        for origin in headers.getlist("origin"):
            if not self._is_own_origin(origin, hosts):
                raise ForeignOrigin(
                    f"a page of {origin!r} sent this request. If that is the address of this "
                    "service behind a proxy, add its host to LAGID_ALLOWED_HOSTS."
                )

    def _is_own_origin(self, origin: str, hosts: list[str]) -> bool:
        """Test whether a page is the service's own: other ports of its host are not.

        A proxy may have written another name into `Host`. Then the allowed names are its own, at
        the usual port.
        """
        scheme, _, authority = origin.lower().partition("://")
        usual_port = ":443" if scheme == "https" else ":80"
        own = {host.strip().lower().removesuffix(usual_port) for host in hosts}
        if authority != "" and authority in own:
            return True
        name = _parse_name(authority)
        is_renamed = authority == name and name not in map(_parse_name, hosts)
        return is_renamed and name in self._settings.allowed_hosts


def _parse_name(authority: str) -> str:
    """Return the host of ``host:port`` in lower case, without brackets; empty if there is none."""
    match = _AUTHORITY.fullmatch(authority.strip().lower())
    return match[1].strip("[]").removesuffix(".") if match else ""


class ResponseHeaders:
    """Middleware that adds headers to every answer that does not have its own."""

    def __init__(self, app: ASGIApp, headers: Mapping[str, str]) -> None:
        self._app, self._headers = app, headers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and add to the head of its answer."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, send_with_headers)
