"""No request makes the server hold more of its body than it may; uploads have a limit of their own.

FastAPI reads a body as a whole before it looks at it, so the limit is set where it is received.
"""

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.core.errors import TooLarge

UPLOAD_ROUTE = ("POST", "/v1/datasets")
"""Goes to a file as it comes (`service.api.content`)."""


class BodyLimit:
    """Middleware that refuses a body of more than `limit` bytes.

    One that is announced as longer is not read at all; another one no further than the limit.
    """

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app, self._limit = app, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Hand the request on, its body watched."""
        if scope["type"] != "http" or (scope["method"], scope["path"]) == UPLOAD_ROUTE:
            await self._app(scope, receive, send)
        else:
            await self._app(scope, self._limit_receive(scope, receive), send)

    def _limit_receive(self, scope: Scope, receive: Receive) -> Receive:
        announced = Headers(scope=scope).get("content-length", "")
        size = 0

        async def watched() -> Message:
            nonlocal size
            if announced.isdecimal():
                self._check_size(int(announced), "")
            message = await receive()
            size += len(message.get("body", b""))
            self._check_size(size, " or more")
            return message

        return watched

    def _check_size(self, size: int, more: str) -> None:
        if size > self._limit:
            raise TooLarge(
                f"the body has {size} bytes{more}; at most {self._limit} (LAGID_MAX_BODY_BYTES)"
            )
