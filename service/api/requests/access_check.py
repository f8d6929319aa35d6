"""Middleware that finds who sends a request, before anything of it is read.

A request without a valid key is answered by 401, or a page by the way to sign in. The scope that a
request needs goes by its method and path (`service.access.scopes`), so that a new route needs one.
"""

from functools import partial
from urllib.parse import quote

from sqlalchemy.exc import SQLAlchemyError
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request, cookie_parser
from starlette.responses import RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from service.access.callers import NOBODY, Caller, Credentials, find_caller, record_refusal
from service.access.scopes import find_needed_scope
from service.api.requests.dependencies import Parts
from service.api.requests.html_answers import wants_html
from service.api.requests.problems import answer_error
from service.api.requests.request_log import get_request_id
from service.api.requests.request_root_path import get_service_path
from service.core.errors import ServiceError, Unauthorized
from service.core.root_path import to_address
from service.core.settings import Settings
from service.pages.render import shown_account
from service.storage.storage_errors import StorageError

COOKIE = "lagid_session"


class AccessCheck:
    """Middleware that lets a request pass if its sender may send it.

    The caller is `request.state.caller`. Whatever serves the request sees its project alone.
    """

    def __init__(self, app: ASGIApp, settings: Settings) -> None:
        self._app, self._settings = app, settings

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on with its caller, or answer it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        # The middleware inside replaces it by the address that a proxy names.
        request.state.peer = request.client.host if request.client else ""
        try:
            caller = await self._admit(request)
        except (ServiceError, StorageError, SQLAlchemyError) as error:
            await self._refuse(request, error)(scope, receive, send)
            return
        request.state.caller = caller
        shown_account.set(caller if caller.name else None)
        await self._app(scope, receive, send)

    async def _admit(self, request: Request) -> Caller:
        needed = find_needed_scope(request.method, get_service_path(request.scope))
        if needed is None:
            return NOBODY
        parts: Parts = request.app.state.parts
        credentials = read_credentials(request, self._settings)
        peer, request_id = request.state.peer, get_request_id(request)
        record = partial(record_refusal, parts.database, address=peer, request_id=request_id)
        async with parts.failures.delay_failures(peer, record):
            caller = await run_in_threadpool(
                find_caller, parts.database, self._settings, credentials
            )
        caller.check_scope(needed)
        return caller

    def _refuse(self, request: Request, error: Exception) -> Response:
        is_signed_out = isinstance(error, Unauthorized) and "authorization" not in request.headers
        if is_signed_out and wants_html(request) and self._settings.auth_mode == "keys":
            query = f"?{request.url.query}" if request.url.query else ""
            target = quote(f"{request.url.path}{query}", safe="/")
            return RedirectResponse(to_address(f"/sign-in?next={target}"), 303)
        return answer_error(request, error)


def is_still_admitted(request: Request, parts: Parts) -> bool:
    """Return whether the sender of a request that takes long would still be admitted.

    A database that is away says nothing about it.
    """
    settings = parts.settings
    try:
        find_caller(parts.database, settings, read_credentials(request, settings))
    except Unauthorized:
        return False
    except SQLAlchemyError:
        pass
    return True


def read_credentials(request: Request, settings: Settings) -> Credentials:
    """Read what a request shows of its sender.

    Behind a proxy that authenticates, any ``Authorization`` but that of a key is the proxy's own.

    Raises
    ------
    Unauthorized
        If the header ``Authorization`` has another form than that of an API key.
    """
    token = None
    if "authorization" in request.headers:
        scheme, _, token = request.headers["authorization"].partition(" ")
        if settings.auth_mode == "proxy" and not token.strip().startswith("lagid_"):
            token = None
        elif scheme.lower() != "bearer" or not token.strip():
            raise Unauthorized(
                f"found the authorization scheme {scheme!r:.30}; need `Bearer lagid_…`",
                is_wrong=True,
            )
    return Credentials(
        token,
        cookie_parser(request.headers.get("cookie", "")).get(COOKIE),
        tuple(request.headers.getlist(settings.proxy_header)),
        request.state.peer,
    )
