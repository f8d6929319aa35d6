"""Routes of access: who asks, the audit log, and the pages to sign in and to manage keys."""

from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Annotated, Any

from fastapi import APIRouter, Form, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from starlette.concurrency import run_in_threadpool

from service.access import keys
from service.access.access_schemas import AccessOut, AuditEntryOut, AuditPage, LimitsOut, UseOut
from service.access.callers import record_refusal, sign_in, sign_out
from service.access.scopes import Scope
from service.api.requests.access_check import COOKIE
from service.api.requests.dependencies import (
    CallerDep,
    Cursor,
    Limit,
    PartsDep,
    ReadSession,
    WriteSession,
)
from service.api.requests.html_answers import HtmlPage
from service.api.requests.request_log import get_request_id
from service.core.errors import InvalidRequest, Unauthorized
from service.core.root_path import get_root_path, to_address
from service.pages.access_pages import keys_page, sign_in_page
from service.queue.admission import count_unfinished
from service.repositories.audit_rows import list_actions
from service.repositories.key_rows import KeyRepository
from service.repositories.project_rows import ProjectRepository

router = APIRouter(tags=["access"])

HIDDEN: dict[str, Any] = {"include_in_schema": False, "response_class": HTMLResponse}
NextPage = Annotated[str, Query(alias="next", max_length=2000)]


@router.get("/v1/access")
def read_access(caller: CallerDep, parts: PartsDep, session: ReadSession) -> AccessOut:
    """Read who asks: key, project, scopes, and the project's limits and use."""
    projects, settings = ProjectRepository(session), parts.settings
    project = projects.get(caller.project_id)
    open_now, used = count_unfinished(session, project.id), projects.measure_use(project.id)
    limits = LimitsOut.from_source(
        project,
        max_open_jobs=_choose(project.max_open_jobs, settings.max_open_jobs),
        max_open_runs=_choose(project.max_open_runs, settings.max_open_runs),
    )
    return AccessOut.from_source(
        caller,
        project=project.id,
        project_name=project.name,
        scopes=list(caller.scopes),
        limits=limits,
        used=UseOut.from_source(used, open_jobs=open_now.jobs, open_runs=open_now.runs),
    )


@router.get("/v1/audit")
def list_audit_entries(
    caller: CallerDep, session: ReadSession, cursor: Cursor = None, limit: Limit = 50
) -> AuditPage:
    """List who did what in the project, latest first; needs the scope admin."""
    page = list_actions(session, caller.project_id, cursor=cursor, limit=limit)
    items = [AuditEntryOut.from_source(row) for row in page.items]
    return AuditPage(items=items, next=page.next)


@router.get("/sign-in", **HIDDEN)
def show_sign_in(next_page: NextPage = "/") -> Response:
    """Show the form that takes a key."""
    return HtmlPage(sign_in_page(_check_local(next_page)))


@router.post("/sign-in", **HIDDEN)
async def start_session(
    request: Request,
    parts: PartsDep,
    key: Annotated[str, Form(max_length=500)] = "",
    next_page: Annotated[str, Form(alias="next", max_length=2000)] = "/",
) -> Response:
    """Start the session of a browser, and lead it to where it was going."""
    target = _check_local(next_page)
    lifetime = timedelta(hours=parts.settings.session_hours)
    address = request.client.host if request.client else ""
    request_id = get_request_id(request)
    record = partial(record_refusal, parts.database, address=address, request_id=request_id)
    start = partial(
        sign_in,
        parts.database,
        key,
        lifetime,
        cookie=request.cookies.get(COOKIE),
        request_id=request_id,
    )
    try:
        async with parts.failures.delay_failures(address, record):
            secret, end = await run_in_threadpool(start)
    except Unauthorized as error:
        return HtmlPage(sign_in_page(target, error.detail), error.status, error.headers)
    answer = RedirectResponse(to_address(target.removeprefix(get_root_path())), 303)
    answer.set_cookie(
        COOKIE,
        secret,
        max_age=int((end - datetime.now(UTC)).total_seconds()),
        path=get_root_path() or "/",
        secure=request.url.scheme == "https",
        httponly=True,
        samesite="strict",
    )
    return answer


@router.post("/sign-out", **HIDDEN)
def end_session(request: Request, parts: PartsDep) -> Response:
    """End the session of a browser."""
    if COOKIE in request.cookies:
        sign_out(parts.database, request.cookies[COOKIE], get_request_id(request))
    answer = RedirectResponse(to_address("/sign-in"), 303)
    answer.delete_cookie(COOKIE, path=get_root_path() or "/", httponly=True, samesite="strict")
    return answer


@router.get("/keys", **HIDDEN)
def show_keys(caller: CallerDep, session: ReadSession) -> Response:
    """Show the keys of the project, and the form of a new one."""
    return HtmlPage(keys_page(session, caller.project_id))


@router.post("/keys", **HIDDEN)
def add_key(
    caller: CallerDep,
    session: WriteSession,
    name: Annotated[str, Form(max_length=500)] = "",
    scope: Annotated[Scope, Form()] = "write",
    days: Annotated[str, Form(max_length=10)] = "",
) -> Response:
    """Create a key, and show it once."""
    try:
        created = keys.create_key(session, caller.project_id, name, scope, _read_days(days))
    except InvalidRequest as error:
        fault = error.detail.removeprefix("/")
        return HtmlPage(keys_page(session, caller.project_id, fault=fault), error.status)
    return HtmlPage(keys_page(session, caller.project_id, created), 201)


@router.post("/keys/{key_id}/revoke", **HIDDEN)
def revoke_key(key_id: str, caller: CallerDep, session: WriteSession) -> Response:
    """End a key at once."""
    KeyRepository(session, caller.project_id).revoke(key_id)
    return RedirectResponse(to_address("/keys"), 303)


def _choose(own: int | None, default: int) -> int:
    return default if own is None else own


def _check_local(target: str) -> str:
    """Return a path of this service; another address leads to the first page."""
    is_local = target.startswith("/") and not target.startswith(("//", "/\\"))
    return target if is_local and target.isprintable() else "/"


def _read_days(text: str) -> int | None:
    if not text.strip():
        return None
    if not text.strip().isdecimal():
        raise InvalidRequest.from_fault("/days", f"found {text!r}; need a number of days")
    return int(text)
