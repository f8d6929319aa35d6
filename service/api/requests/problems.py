"""Turn every error into an RFC 9457 problem document."""

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import TimeoutError as SqlTimeout
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, Response

from service.api.requests.html_answers import PROTECTIVE_HEADERS, error_page, wants_html
from service.api.requests.request_log import REQUEST_ID_HEADER, get_request_id
from service.core.bodies.text_checks import LONE_SURROGATE
from service.core.bodies.validation import describe_error, explain_errors, find_body_type
from service.core.errors import (
    Conflict,
    DamagedObject,
    FieldError,
    InvalidRequest,
    InvalidUpload,
    NotFound,
    ServiceError,
    Unavailable,
    UnsupportedMediaType,
    to_field_errors,
)
from service.core.process import service_metrics
from service.core.process.temporary_files import FULL_DISK_ERRORS, FULL_DISK_MESSAGE
from service.core.root_path import to_address
from service.storage.retry import TRANSIENT_ERRORS, is_transient
from service.storage.storage_errors import InvalidCursor, ObjectDamaged, StorageError
from sysid.core.errors import SysidError, UnreadableFile

log = logging.getLogger(__name__)

TOO_DEEP_MESSAGE = "the body is nested too deeply"
MAX_FAULTS = 1000
"""Limit on reported fields, since each one is compared with the valid names."""
MAX_DETAIL_CHARACTERS, MAX_TOTAL_CHARACTERS = 1000, 20_000
"""Limits for one message and for all: a quoted value may be as long as the body."""
CLIENT_GONE = 499
PROBLEM_TYPE = "application/problem+json"
STATUS_KINDS = {
    404: "not-found",
    405: "method-not-allowed",
    413: "too-large",
    415: "unsupported-media-type",
}

STORAGE_KINDS = {
    error_type.status: (error_type.kind, error_type.title)
    for error_type in (NotFound, Conflict, InvalidRequest)
}


def problem_response(
    request: Request,
    status: int,
    kind: str,
    title: str,
    detail: str,
    errors: Sequence[FieldError] = (),
    headers: Mapping[str, str] | None = None,
    members: Mapping[str, Any] | None = None,
) -> Response:
    """Answer with a problem document; its `type` is a path of this server, one per kind.

    A browser that requests a page gets the same content as a page.
    """
    if wants_html(request):
        return error_page(status, title, detail, errors, headers or {})
    content: dict[str, Any] = {
        "type": to_address(f"/problems/{kind}"),
        "title": title,
        "status": status,
        "detail": _shorten(detail, MAX_TOTAL_CHARACTERS if errors else MAX_DETAIL_CHARACTERS),
        "instance": request.url.path,
        "request_id": get_request_id(request),
        **(members or {}),
    }
    if errors:
        entries = [error.to_dict() for error in errors[: MAX_FAULTS + 1]]
        if len(errors) > len(entries):
            entries.append(FieldError("", "more faults follow; they are not listed").to_dict())
        content["errors"] = [
            {**entry, "detail": _shorten(entry["detail"], MAX_DETAIL_CHARACTERS)}
            for entry in entries
        ]
    all_headers = {"Vary": "Accept", **(headers or {})}  # caches keep JSON and page apart
    return _ProblemResponse(content, status, all_headers, media_type=PROBLEM_TYPE)


class _ProblemResponse(JSONResponse):
    """A JSON response that escapes lone surrogates, which a quoted field name may contain."""

    def render(self, content: Any) -> bytes:
        """Encode the document in UTF-8."""
        text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
        return text.encode("utf-8", "backslashreplace")


def _shorten(text: str, most: int) -> str:
    """Shorten a long text to its beginning and end."""
    return text if len(text) <= most else f"{text[: most // 2]} … {text[-(most // 2) :]}"


def install_handlers(app: FastAPI) -> None:
    """Register handlers that turn every error into a problem document."""
    app.add_exception_handler(ServiceError, _handle_service_error)
    app.add_exception_handler(StorageError, _handle_storage_error)
    app.add_exception_handler(SysidError, _handle_sysid_error)
    app.add_exception_handler(RequestValidationError, _handle_validation_error)
    app.add_exception_handler(HTTPException, _handle_http_error)
    for passing in (*TRANSIENT_ERRORS, SqlTimeout):
        app.add_exception_handler(passing, _handle_database_outage)
    app.add_exception_handler(ClientDisconnect, _handle_disconnect)
    app.add_exception_handler(RecursionError, _handle_recursion_error)
    app.add_exception_handler(UnicodeEncodeError, _handle_unicode_error)
    app.add_exception_handler(OSError, _handle_os_error)
    app.add_exception_handler(Exception, _handle_unexpected_error)


def error_response(request: Request, error: ServiceError) -> Response:
    """Answer with the problem document of an error that the service raises on purpose."""
    return problem_response(
        request,
        error.status,
        error.kind,
        error.title,
        error.detail,
        error.errors,
        error.headers,
        error.members,
    )


def answer_error(request: Request, error: Exception) -> Response:
    """Answer with the document that an error has in a route, for middleware around all routes.

    An error that no handler knows is raised again.
    """
    handlers = request.app.exception_handlers
    for kind in type(error).__mro__[:-2]:  # not that of all other errors
        if kind in handlers:
            response: Response = handlers[kind](request, error)
            return response
    raise error


def _handle_service_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, ServiceError)
    return error_response(request, error)


def _handle_storage_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, StorageError)
    if error.status >= HTTPStatus.INTERNAL_SERVER_ERROR:
        log.error("%s %s: %s", request.method, request.url.path, error)
    if error.status == Unavailable.status:
        return error_response(request, Unavailable(str(error)))
    if isinstance(error, InvalidCursor):
        return error_response(request, InvalidRequest.from_fault("?cursor", str(error)))
    if isinstance(error, ObjectDamaged):
        return error_response(request, DamagedObject(str(error)))
    kind, title = STORAGE_KINDS.get(error.status, ("internal", "The service failed"))
    return problem_response(request, error.status, kind, title, str(error))


def _handle_database_outage(request: Request, error: Exception) -> Response:
    if isinstance(error, TRANSIENT_ERRORS) and not is_transient(error):
        return _handle_unexpected_error(request, error)
    log.error("%s %s: %s", request.method, request.url.path, str(error).splitlines()[0])
    detail = "the database does not answer, or its disk is full. Nothing was changed. Try again."
    if isinstance(error, SqlTimeout):
        service_metrics.store_errors.labels("database").inc()
        detail = "all connections to the database are in use. Nothing was changed. Try again."
    return error_response(request, Unavailable(detail))


def _handle_disconnect(request: Request, _error: Exception) -> Response:
    """Answer nobody: the sender of a body has gone. Log and metrics have nginx's status of that."""
    log.info("%s %s: the sender broke off", request.method, request.url.path)
    return Response(status_code=CLIENT_GONE)


def _handle_os_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, OSError)
    if error.errno not in FULL_DISK_ERRORS:
        return _handle_unexpected_error(request, error)
    log.error("%s %s: %s", request.method, request.url.path, error)
    return error_response(request, Unavailable(FULL_DISK_MESSAGE))


def _handle_recursion_error(request: Request, error: Exception) -> Response:
    """Report a body that is nested too deeply; only bodies are parsed recursively."""
    if request.method not in ("POST", "PUT", "PATCH"):
        return _handle_unexpected_error(request, error)
    return _handle_service_error(request, InvalidRequest.from_fault("", TOO_DEEP_MESSAGE))


def _handle_unicode_error(request: Request, error: Exception) -> Response:
    """Report a lone surrogate, which only JSON escapes in a body can produce."""
    if request.method not in ("POST", "PUT", "PATCH"):
        return _handle_unexpected_error(request, error)
    return _handle_service_error(request, InvalidRequest.from_fault("", LONE_SURROGATE))


def _handle_sysid_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, SysidError)
    if isinstance(error, UnreadableFile):
        return _handle_service_error(request, InvalidUpload(error))
    return _handle_service_error(request, InvalidRequest(to_field_errors(error)))


def _handle_http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    if isinstance(error.__cause__, ServiceError):  # from where FastAPI reads the body
        return _handle_service_error(request, error.__cause__)
    reason = _unreadable_reason(error.__cause__)
    if error.status_code == HTTPStatus.BAD_REQUEST and reason:
        return _handle_service_error(request, InvalidRequest.from_fault("", reason))
    status = HTTPStatus(error.status_code)
    kind = STATUS_KINDS.get(status, status.phrase.lower().replace(" ", "-"))
    detail = error.detail
    if status in (HTTPStatus.NOT_FOUND, HTTPStatus.METHOD_NOT_ALLOWED):
        detail = f"{request.method} {request.url.path}: {status.phrase.lower()}; see /docs"
    return problem_response(request, status, kind, status.phrase, detail, headers=error.headers)


def _handle_validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    if isinstance(error.body, bytes):  # FastAPI parses only bodies with a JSON content type
        kind = request.headers.get("content-type", "")
        return _handle_service_error(
            request, UnsupportedMediaType(f"found {kind!r}; need application/json")
        )
    return _handle_service_error(request, InvalidRequest(_to_field_errors(request, error)))


def _handle_unexpected_error(request: Request, error: Exception) -> Response:
    # Starlette logs the traceback. The client gets no internal detail.
    log.error("%s %s failed: %r", request.method, request.url.path, error)
    detail = "unexpected error; see the server's log"
    # This answer does not pass the middleware.
    headers = {**PROTECTIVE_HEADERS, REQUEST_ID_HEADER: get_request_id(request)}
    return problem_response(request, 500, "internal", "The service failed", detail, headers=headers)


def _unreadable_reason(cause: BaseException | None) -> str | None:
    """Explain why a body could not be parsed as JSON; FastAPI reports only that it failed."""
    match cause:
        case UnicodeDecodeError():
            return f"the body is not UTF-8 text: byte {cause.start} is invalid"
        case RecursionError():
            return TOO_DEEP_MESSAGE
        case ValueError():
            return "the body has a number with more than 4300 digits"
    return None


def _find_position(text: str, index: int) -> str:
    """Return line and column of a character, both from 1."""
    before = text[:index]
    return f"line {before.count(chr(10)) + 1}, column {index - before.rfind(chr(10))}"


def _to_field_errors(request: Request, error: RequestValidationError) -> Iterator[FieldError]:
    entries = []
    for entry in error.errors():
        source, loc = entry["loc"][0], entry["loc"][1:]
        if entry["type"] == "json_invalid":
            position = _find_position(str(error.body), int(loc[0]))
            yield FieldError("", f"the body is not JSON: {position}: {entry['ctx']['error']}")
        elif source == "body":
            entries.append({**entry, "loc": loc})
        else:
            # The rest of `loc` is an index into repeated values.
            name = loc[0] if loc else ""
            pointer = f"{{{name}}}" if source == "path" else f"?{name}"
            yield FieldError(pointer, describe_error(entry, ()))
    kind = find_body_type(request.scope.get("endpoint"))
    yield from explain_errors(entries[:MAX_FAULTS], error.body, kind)
    if len(entries) > MAX_FAULTS:
        yield FieldError("", f"{len(entries) - MAX_FAULTS} more faults are not listed")
