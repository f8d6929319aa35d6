"""Limit the size of request bodies; uploads have a separate limit.

FastAPI reads a whole body before it parses it, so the limit must apply while it is received.
"""

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.core.errors import TooLarge

UPLOAD_ROUTE = ("POST", "/v1/datasets")
"""The upload goes to a file while it arrives (`service.api.content`)."""


class BodyLimit:
    """Middleware that refuses a body of more than `limit` bytes.

    A body that is announced as longer is not read at all. Any other body is read up to the limit.
    """

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app, self._limit = app, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on and count the bytes of its body."""
        if scope["type"] != "http" or (scope["method"], scope["path"]) == UPLOAD_ROUTE:
            await self._app(scope, receive, send)
        else:
            await self._app(scope, self._limit_receive(scope, receive), send)

    def _limit_receive(self, scope: Scope, receive: Receive) -> Receive:
        announced = Headers(scope=scope).get("content-length", "")
        size = 0

        async def receive_counted() -> Message:
            nonlocal size
            if announced.isdecimal():
                self._check_size(int(announced), "")
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
