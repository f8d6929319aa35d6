"""The id of each request, its line in the access log, and its metrics."""

import logging
import re
import uuid
from time import perf_counter

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.core.process import service_metrics
from service.core.process.logs import ACCESS_LOGGER, bind_request

REQUEST_ID_HEADER = "X-Request-ID"
_REQUEST_ID_KEY = "lagid.request_id"
_SANE_ID = re.compile(r"[A-Za-z0-9._:+/=@-]{1,128}")
KNOWN_METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
OTHER = "other"
"""Label of methods and paths that no route has."""
_access_log = logging.getLogger(ACCESS_LOGGER)


def get_request_id(request: Request) -> str:
    """Return the id of a request, as its answer and the log lines have it."""
    return str(request.scope.get(_REQUEST_ID_KEY, ""))


class RequestLog:
    """Outermost middleware: the id of each request, its line in the access log, and its metrics.

    A sane `X-Request-ID` of the sender is kept, so that a proxy's log and ours have the same one.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and watch its answer."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request_id = _choose_request_id(Headers(scope=scope))
        scope[_REQUEST_ID_KEY] = request_id
        bind_request(request_id)
        begun, status, head_seconds = perf_counter(), 500, None

        async def send_with_id(message: Message) -> None:
            nonlocal status, head_seconds
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[REQUEST_ID_HEADER] = request_id
                status, head_seconds = message["status"], perf_counter() - begun
            await send(message)

        try:
            await self._app(scope, receive, send_with_id)
        finally:  # an unexpected error is answered by 500, outside of all middleware
            total = perf_counter() - begun
            _record_answer(scope, status, total if head_seconds is None else head_seconds, total)


def _choose_request_id(headers: Headers) -> str:
    given = headers.get(REQUEST_ID_HEADER, "")
    return given if _SANE_ID.fullmatch(given) else uuid.uuid4().hex


def _record_answer(scope: Scope, status: int, head_seconds: float, total: float) -> None:
    method = scope["method"] if scope["method"] in KNOWN_METHODS else OTHER
    route = str(getattr(scope.get("route"), "path", OTHER))
    service_metrics.requests.labels(method, route, status).inc()
    service_metrics.request_seconds.labels(method, route).observe(head_seconds)
    if _access_log.isEnabledFor(logging.INFO):
        seconds = round(total, 4)
        facts = {
            "method": method,
            "path": scope["path"],
            "route": route,
            "status": status,
            "seconds": seconds,
        }
        _access_log.info("%s %s %d in %g s", method, scope["path"], status, seconds, extra=facts)
