"""The calls of the REST interface as values, shared by both clients; loads no HTTP library.

It also holds the errors of the clients, the events of a job, and when a call is sent again.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http import HTTPStatus
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar
from urllib.parse import quote
from uuid import uuid4

from service.core.states import JobState

if TYPE_CHECKING:
    import httpx

    from service.client import documents


Document: TypeAlias = dict[str, Any]
Answer = TypeVar("Answer")
"""What a call is answered with; an item, if it is a list."""

DEFAULT_URL = "http://127.0.0.1:8000"
URL_VARIABLE = "LAGID_URL"
KEY_VARIABLES = ("LAGID_API_KEY", "LAGID_KEY")
TERMINAL_STATES = frozenset(state.value for state in JobState if state.is_terminal)
FILE_TYPE = "application/octet-stream"  # the server recognises the kind by the bytes
MCAP_TYPE = "application/x-mcap"
IDEMPOTENCY_HEADER = "Idempotency-Key"

POLL_SECONDS = 0.3
TIMEOUT_SECONDS = 60.0
EVENT_TIMEOUT_SECONDS = 45.0
"""Three times the pause between two signs of life of an event stream."""


def choose_url(url: str | None) -> str:
    """Return the address of the server: as given, else that of LAGID_URL, else the default.

    Raises
    ------
    ClientError
        If it does not begin with http:// or https://.
    """
    chosen = (url or os.environ.get(URL_VARIABLE) or DEFAULT_URL).rstrip("/")
    if not chosen.lower().startswith(("http://", "https://")):
        raise ClientError(f"found the address {chosen!r}; write http://{chosen.split('://')[-1]}")
    return chosen


def choose_key(key: str | None) -> str | None:
    """Return the API key: as given, else that of LAGID_API_KEY, else none.

    Raises
    ------
    ClientError
        If it cannot be sent.
    """
    given = (os.environ.get(name) for name in KEY_VARIABLES)
    chosen = (key or next((value for value in given if value), "")).strip()
    if not (chosen.isascii() and chosen.isprintable()):  # it is not quoted: it may be secret
        raise ClientError("the API key has characters that no key has; copy it again")
    return chosen or None


def make_auth_header(key: str | None) -> dict[str, str]:
    """Make the header that carries an API key."""
    return {"Authorization": f"Bearer {key}"} if key else {}


class ClientError(Exception):
    """Base class of the errors that a client raises on purpose.

    Subclasses: ProblemError, ServerUnreachable, WaitTimeout and NotFinite.
    """


class ProblemError(ClientError):
    """The server refused a request.

    Attributes
    ----------
    status : int
    document : dict
        The RFC 9457 problem document; ``errors`` lists each fault with its JSON pointer.
    reason : str
        Text of the refusal, in one line.
    """

    def __init__(self, status: int, document: Document) -> None:
        self.status, self.document = status, document
        faults = [_describe_fault(entry) for entry in document.get("errors", [])]
        self.reason = "; ".join(faults) or str(document.get("detail", ""))
        super().__init__(f"{document.get('title', 'error')} ({status}): {self.reason}")


class ServerUnreachable(ClientError):
    """No server answers at the address."""

    def __init__(self, url: str, error: Exception) -> None:
        reason = str(error) or type(error).__name__
        super().__init__(
            f"no lagid server answers at {url} ({reason}). Start one with `lagid serve`, "
            "or give another address with --url or LAGID_URL."
        )


class WaitTimeout(ClientError):
    """A job has not ended in time; it goes on.

    Attributes
    ----------
    job : dict
        The last state of the job.
    """

    def __init__(self, job: "documents.JobDocument", seconds: float) -> None:
        self.job = job
        super().__init__(f"{job['id']} has not ended after {seconds:g} s; it is {job['state']}")


class NotFinite(ClientError):
    """A body contains a number that JSON cannot represent; it was not sent.

    Attributes
    ----------
    pointer : str
        Position of the number in the body.
    reason : str
        What was found there, and what is needed.
    """

    def __init__(self, pointer: str, value: float) -> None:
        self.pointer, self.reason = pointer, f"found {value}; need a finite number"
        super().__init__(f"{pointer or 'body'}: {self.reason}")


@dataclass(frozen=True, slots=True)
class RestCall(Generic[Answer]):
    """One request, not yet sent, and the type of its answer, or of an item of it if it is a list.

    `timeout` is its own longest time without a byte, s; by default that of the client. `at_most` is
    the number of items that are wanted of a list; by default all.

    Raises
    ------
    NotFinite
        If a number of the body is infinite or NaN.
    """

    method: str
    path: str
    params: Mapping[str, Any] = field(default_factory=dict)
    json: Any = None
    content: bytes | Path | None = None
    headers: Mapping[str, str] = field(default_factory=dict)
    timeout: float | None = None
    at_most: int | None = None

    def __post_init__(self) -> None:
        _check_finite("", self.json)

    def request(self, content: Any) -> dict[str, Any]:
        """Return the arguments of httpx's ``build_request``."""
        request = {"method": self.method, "url": self.path, "content": content, "json": self.json}
        limit = {} if self.timeout is None else {"timeout": self.timeout}
        return {**request, "params": dict(self.params), "headers": dict(self.headers), **limit}

    def limit_to(self, at_most: int | None) -> "RestCall[Answer]":
        """Return the call of a list of which so many items are wanted."""
        return replace(self, at_most=at_most)


def _check_finite(pointer: str, value: Any) -> None:
    if isinstance(value, float) and not isfinite(value):
        raise NotFinite(pointer, value)
    if isinstance(value, Mapping):
        for name, item in value.items():
            part = str(name).replace("~", "~0").replace("/", "~1")
            _check_finite(f"{pointer}/{part}", item)
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _check_finite(f"{pointer}/{index}", item)


def call(route: str, /, *names: str, json: Any = None, **params: Any) -> RestCall[Any]:
    """Build the call of a route, such as ``GET /v1/jobs/{}``, for resources of these names.

    Parameters of the query that are None are left out.
    """
    method, path = route.split()
    query = {key: _to_query(value) for key, value in params.items() if value is not None}
    return RestCall(method, path.format(*(quote(name, safe="") for name in names)), query, json)


def _to_query(value: Any) -> Any:
    is_list = isinstance(value, Sequence) and not isinstance(value, str)
    return list(value) if is_list else value


def build_edit(
    route: str, name: str, changes: Mapping[str, Any], if_match: str | None
) -> RestCall[Any]:
    """Build a call that changes name, note or tags, by `if_match` only of that version."""
    headers = {} if if_match is None else {"If-Match": if_match}
    return replace(call(route, name, json=changes), headers=headers)


def build_submission(route: str, body: Mapping[str, Any], key: str | None) -> RestCall[Any]:
    """Build a call that queues a job; the same idempotency key again returns the same job.

    Without a key the call gets a random one, so that it can be repeated if no response came.
    """
    return replace(call(route, json=body), headers={IDEMPOTENCY_HEADER: key or uuid4().hex})


def build_event_stream(job: str, after: str | None) -> RestCall[bytes]:
    """Build the call for a job's events, or for those after an event."""
    headers = {"Last-Event-ID": after} if after else {}
    stream = call("GET /v1/jobs/{}/events", job)
    return replace(stream, headers=headers, timeout=EVENT_TIMEOUT_SECONDS)


def build_upload(
    source: str | Path | bytes, name: str | None, options: Mapping[str, str | float | None]
) -> RestCall[Any]:
    """Build the call that stores a file or bytes; `options` say how it is read."""
    content = source if isinstance(source, bytes) else Path(source)
    kind = FILE_TYPE
    if isinstance(content, Path):
        kind = MCAP_TYPE if content.suffix.lower() == ".mcap" else FILE_TYPE
        name = name or content.name.removesuffix(".gz").rpartition(".")[0] or content.name
    upload = call("POST /v1/datasets", name=name, **options)
    return replace(upload, content=content, headers={"content-type": kind})


def raise_for_problem(response: "httpx.Response") -> "httpx.Response":
    """Return the response, or raise its error.

    Raises
    ------
    ProblemError
        With the problem document. If the response is not one of lagid, a document is made for it.
    """
    if response.is_success:
        return response
    try:
        document = response.json()
    except ValueError:
        document = None
    if not isinstance(document, dict):
        title, detail = response.reason_phrase, response.text[:200]
        document = {"title": title, "status": response.status_code, "detail": detail}
    raise ProblemError(response.status_code, document)


class EventParser:
    """Parses the lines of a stream of server-sent events."""

    def __init__(self) -> None:
        self._fields: dict[str, str] = {}

    def feed_line(self, line: str) -> Document | None:
        """Take one line; return the event that it completes, with its data decoded from JSON."""
        if line:
            key, _, value = line.partition(":")
            if key:  # a line that begins with a colon is a comment that keeps the line open
                self._fields[key] = value.removeprefix(" ")
            return None
        fields, self._fields = self._fields, {}
        if "data" not in fields:
            return None
        kind = fields.get("event", "message")
        return {"id": fields.get("id"), "event": kind, "data": json.loads(fields["data"])}


def _describe_fault(entry: Mapping[str, Any]) -> str:
    column = f", column {entry['column']}" if entry.get("column") is not None else ""
    return f"{entry.get('pointer') or 'body'}{column}: {entry.get('detail')}"


DEFAULT_RETRIES = 4
FIRST_PAUSE_SECONDS = 0.5
"""Pause before the second attempt, if the server names none; it doubles with each attempt."""
MAX_PAUSE_SECONDS = 30.0
"""Longest pause. If the server asks for a longer one, the call is not repeated."""
REPEATABLE_METHODS = frozenset({"GET", "HEAD", "PUT", "DELETE"})
TEMPORARY_STATUSES = (HTTPStatus.TOO_MANY_REQUESTS, HTTPStatus.SERVICE_UNAVAILABLE)


def plan_pauses(call: RestCall[Any], retries: int) -> "Iterator[float]":
    """Yield the seconds to wait before each further attempt, if the server names none.

    A request that might be carried out twice has none: a POST without an idempotency key.
    """
    if call.method in REPEATABLE_METHODS or IDEMPOTENCY_HEADER in call.headers:
        for number in range(retries):
            yield FIRST_PAUSE_SECONDS * 2**number


def choose_pause(response: "httpx.Response", pauses: "Iterator[float]") -> float | None:
    """Return the seconds until a call is sent again; None if its response is final.

    Parameters
    ----------
    response : httpx.Response
        Status 429 and 503 are temporary. ``Retry-After`` sets the pause, in seconds or as a date
        (RFC 9110, section 10.2.3).
    pauses : iterator of float
        The remaining pauses of this call; one is taken.
    """
    if response.status_code not in TEMPORARY_STATUSES:
        return None
    pause = next(pauses, None)
    if pause is None:
        return None
    requested = _parse_retry_after(response.headers.get("Retry-After"))
    pause = pause if requested is None else requested
    return pause if pause <= MAX_PAUSE_SECONDS else None


def _parse_retry_after(header: str | None) -> float | None:
    """Return the seconds of a ``Retry-After`` header; None if it is missing or invalid."""
    if header is None:
        return None
    if header.strip().isdecimal():
        return float(header)
    try:
        until = parsedate_to_datetime(header)
    except (ValueError, OverflowError):  # the latter if the zone exceeds an integer
        return None
    if until.tzinfo is None:  # RFC 5322's -0000; HTTP dates are in GMT
        until = until.replace(tzinfo=UTC)
    return max(0.0, (until - datetime.now(UTC)).total_seconds())
