"""RFC 9457 problem documents: the one place where an error becomes an answer."""

import errno
import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from sqlalchemy.exc import TimeoutError as SqlTimeout
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response

from service.api.html import error_page, is_for_people
from service.core.errors import (
    Conflict,
    FieldError,
    InvalidRequest,
    NotFound,
    ServiceError,
    Unavailable,
    UnsupportedMediaType,
    faults_of,
)
from service.core.text_checks import HALF_A_PAIR
from service.core.validation import body_type, detail_of, explained
from service.storage.errors import StorageError
from service.storage.retry import PASSING, is_passing
from sysid.core.errors import SysidError

log = logging.getLogger(__name__)

TRY_AGAIN = {"Retry-After": "1"}
TOO_DEEP = "the body is nested too deeply"
MOST_FAULTS = 1000
MOST_CHARACTERS, MOST_IN_ALL = 1000, 20_000
"""Of one sentence, and of all: a value that is quoted may be as long as a body."""
"""So many fields that cannot be read are told; each costs a look at what is known there."""
PROBLEM_TYPE = "application/problem+json"
KINDS = {
    404: "not-found",
    405: "method-not-allowed",
    413: "too-large",
    415: "unsupported-media-type",
}

STORAGE_KINDS = {
    known.status: (known.kind, known.title)
    for known in (NotFound, Conflict, InvalidRequest, Unavailable)
}


def problem(
    request: Request,
    status: int,
    kind: str,
    title: str,
    detail: str,
    errors: Sequence[FieldError] = (),
    headers: Mapping[str, str] | None = None,
) -> Response:
    """Answer with a problem document; its `type` is a path of this server, one per kind.

    A browser that asked for a page gets one that says the same.
    """
    if is_for_people(request):
        return error_page(status, title, detail, errors, headers or {})
    content: dict[str, Any] = {
        "type": f"/problems/{kind}",
        "title": title,
        "status": status,
        "detail": _short(detail, MOST_IN_ALL if errors else MOST_CHARACTERS),
        "instance": request.url.path,
    }
    if errors:
        told = [error.as_dict() for error in errors[: MOST_FAULTS + 1]]
        if len(errors) > len(told):
            told.append(FieldError("", "and more faults, not told here").as_dict())
        content["errors"] = [
            {**one, "detail": _short(one["detail"], MOST_CHARACTERS)} for one in told
        ]
    given = {"Vary": "Accept", **(headers or {})}  # no cache gives it to who asks for a page
    return _Problem(content, status, given, media_type=PROBLEM_TYPE)


class _Problem(JSONResponse):
    """JSON also where it names a field whose name is no Unicode text: halves of pairs escaped."""

    def render(self, content: Any) -> bytes:
        """The document in UTF-8."""
        text = json.dumps(content, ensure_ascii=False, separators=(",", ":"))
        return text.encode("utf-8", "backslashreplace")


def _short(text: str, most: int) -> str:
    """The text, of a very long one beginning and end."""
    return text if len(text) <= most else f"{text[: most // 2]} … {text[-(most // 2) :]}"


def install(app: FastAPI) -> None:
    """Make every error of the application a problem document."""
    app.add_exception_handler(ServiceError, _service_error)
    app.add_exception_handler(StorageError, _storage_error)
    app.add_exception_handler(SysidError, _sysid_error)
    app.add_exception_handler(RequestValidationError, _validation_error)
    app.add_exception_handler(HTTPException, _http_error)
    for passing in (*PASSING, SqlTimeout):
        app.add_exception_handler(passing, _database_away)
    app.add_exception_handler(RecursionError, _too_deep)
    app.add_exception_handler(UnicodeEncodeError, _no_unicode)
    app.add_exception_handler(OSError, _system_error)
    app.add_exception_handler(Exception, _unexpected)


def _service_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, ServiceError)
    return problem(
        request, error.status, error.kind, error.title, error.detail, error.errors, error.headers
    )


def _storage_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, StorageError)
    if error.status >= HTTPStatus.INTERNAL_SERVER_ERROR:
        log.error("%s %s: %s", request.method, request.url.path, error)
    kind, title = STORAGE_KINDS.get(error.status, ("internal", "The service failed"))
    return problem(request, error.status, kind, title, str(error))


def _database_away(request: Request, error: Exception) -> Response:
    if isinstance(error, PASSING) and not is_passing(error):
        return _unexpected(request, error)
    log.error("%s %s: %s", request.method, request.url.path, str(error).splitlines()[0])
    detail = "the database does not answer, or its disk is full; nothing was changed, try again"
    away = Unavailable(detail)
    return problem(request, away.status, away.kind, away.title, away.detail, headers=TRY_AGAIN)


def _system_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, OSError)
    if error.errno not in (errno.ENOSPC, errno.EDQUOT):
        return _unexpected(request, error)
    log.error("%s %s: %s", request.method, request.url.path, error)
    return _service_error(request, Unavailable("there is no space left on a disk of the server"))


def _too_deep(request: Request, error: Exception) -> Response:
    """Only a body has levels that are followed one by one."""
    if request.method not in ("POST", "PUT", "PATCH"):
        return _unexpected(request, error)
    return _service_error(request, InvalidRequest.at("", TOO_DEEP))


def _no_unicode(request: Request, error: Exception) -> Response:
    """Only the escapes of a body's JSON can make half of a surrogate pair; UTF-8 has none."""
    if request.method not in ("POST", "PUT", "PATCH"):
        return _unexpected(request, error)
    return _service_error(request, InvalidRequest.at("", HALF_A_PAIR))


def _sysid_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, SysidError)
    return _service_error(request, InvalidRequest(faults_of(error)))


def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    if isinstance(error.__cause__, ServiceError):  # from where FastAPI reads the body
        return _service_error(request, error.__cause__)
    reason = _unreadable(error.__cause__)
    if error.status_code == HTTPStatus.BAD_REQUEST and reason:
        return _service_error(request, InvalidRequest.at("", reason))
    status = HTTPStatus(error.status_code)
    kind = KINDS.get(status, status.phrase.lower().replace(" ", "-"))
    detail = error.detail
    if status in (HTTPStatus.NOT_FOUND, HTTPStatus.METHOD_NOT_ALLOWED):
        detail = f"{request.method} {request.url.path}: {status.phrase.lower()}; see /docs"
    return problem(request, status, kind, status.phrase, detail, headers=error.headers)


def _validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    if isinstance(error.body, bytes):  # FastAPI reads no body that is not announced as JSON
        kind = request.headers.get("content-type", "")
        return _service_error(
            request, UnsupportedMediaType(f"found {kind!r}; need application/json")
        )
    return _service_error(request, InvalidRequest(_field_errors(request, error)))


def _unexpected(request: Request, error: Exception) -> Response:
    # Starlette logs the traceback of what reaches this border; the caller learns no inner detail.
    log.error("%s %s failed: %r", request.method, request.url.path, error)
    detail = "an unexpected error; it is in the log of the server"
    return problem(request, 500, "internal", "The service failed", detail)


def _unreadable(cause: BaseException | None) -> str | None:
    """Why a body could not be read as JSON, where FastAPI only says that it could not."""
    match cause:
        case UnicodeDecodeError():
            return f"the body is not UTF-8 text: byte {cause.start} does not fit"
        case RecursionError():
            return TOO_DEEP
        case ValueError():
            return "the body has a number with too many digits; need at most 4300"
    return None


def _field_errors(request: Request, error: RequestValidationError) -> Iterator[FieldError]:
    entries = []
    for entry in error.errors():
        place, loc = entry["loc"][0], entry["loc"][1:]
        if entry["type"] == "json_invalid":
            yield FieldError("", f"the body is not JSON: {entry['ctx']['error']} at {loc[0]}")
        elif place == "body":
            entries.append({**entry, "loc": loc})
        else:
            # What follows the name is a position among its values.
            name = loc[0] if loc else ""
            pointer = f"{{{name}}}" if place == "path" else f"?{name}"
            yield FieldError(pointer, detail_of(entry, ()))
    kind = body_type(request.scope.get("endpoint"))
    yield from explained(entries[:MOST_FAULTS], error.body, kind)
    if len(entries) > MOST_FAULTS:
        yield FieldError("", f"and {len(entries) - MOST_FAULTS} more faults, not told here")
