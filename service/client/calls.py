"""The calls of the REST interface as values, shared by both clients; loads no HTTP library.

It also holds the errors of the clients, the pages of a list, the events of a job, and the retries.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http import HTTPStatus
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import quote
from uuid import uuid4

from service.core.states import JobState

if TYPE_CHECKING:
    import httpx


Document: TypeAlias = dict[str, Any]

DEFAULT_URL = "http://127.0.0.1:8000"
TERMINAL_STATES = frozenset(state.value for state in JobState if state.is_terminal)
FILE_TYPE = "application/octet-stream"  # the server recognises the kind by the bytes
MCAP_TYPE = "application/x-mcap"
IDEMPOTENCY_HEADER = "Idempotency-Key"

POLL_SECONDS = 0.3
TIMEOUT_SECONDS = 60.0
PAGE_SIZE = 500


def make_auth_header(key: str | None) -> dict[str, str]:
    """Make the header that carries an API key."""
    return {"Authorization": f"Bearer {key}"} if key else {}


class ClientError(Exception):
    """Base class of the errors that a client raises on purpose.

    Subclasses: ProblemError, ServerUnreachable and NotFinite.
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
class RestCall:
    """One request, not yet sent.

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

    def __post_init__(self) -> None:
        _check_finite("", self.json)

    def request(self, content: Any, *, stream: bool) -> dict[str, Any]:
        """Return the arguments of httpx's ``build_request``; a stream has no time limit."""
        request = {"method": self.method, "url": self.path, "content": content, "json": self.json}
        limit = {"timeout": None} if stream else {}
        return {**request, "params": dict(self.params), "headers": dict(self.headers), **limit}


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


@dataclass(frozen=True, slots=True)
class Endpoint:
    """An endpoint: its method, and its path below ``/v1/`` with ``{}`` for each name."""

    method: str
    path: str

    def __call__(self, *names: str, json: Any = None, **params: Any) -> RestCall:
        """Build the call for resources of these names; parameters that are None are left out."""
        path = self.path.format(*(quote(name, safe="") for name in names))
        query = {key: _to_query(value) for key, value in params.items() if value is not None}
        return RestCall(self.method, f"/v1/{path}", query, json)


def _to_query(value: Any) -> Any:
    is_list = isinstance(value, Sequence) and not isinstance(value, str)
    return list(value) if is_list else value


ADD_DATASET = Endpoint("POST", "datasets")
SIMULATE_DATASET = Endpoint("POST", "datasets:simulate")
DERIVE = Endpoint("POST", "datasets/{}:derive")
DATASETS = Endpoint("GET", "datasets")
DATASET = Endpoint("GET", "datasets/{}")
EDIT_DATASET = Endpoint("PATCH", "datasets/{}")
DELETE_DATASET = Endpoint("DELETE", "datasets/{}")
SIGNALS = Endpoint("GET", "datasets/{}/signals")
LINEAGE = Endpoint("GET", "datasets/{}/lineage")
CONTENT = Endpoint("GET", "datasets/{}/content")
CONTENT_CSV = Endpoint("GET", "datasets/{}/content.csv")

MODELS = Endpoint("GET", "models")
MODEL = Endpoint("GET", "models/{}")
EDIT_MODEL = Endpoint("PATCH", "models/{}")
DELETE_MODEL = Endpoint("DELETE", "models/{}")
ADD_MODEL = Endpoint("POST", "models")
CHECK_MODEL = Endpoint("POST", "models:check")

SUBMIT = Endpoint("POST", "jobs")
NOISE_SWEEP = Endpoint("POST", "recipes/noise-sweep")
REIDENTIFY = Endpoint("POST", "recipes/reidentify")
JOBS = Endpoint("GET", "jobs")
JOB = Endpoint("GET", "jobs/{}")
EDIT_JOB = Endpoint("PATCH", "jobs/{}")
DELETE_JOB = Endpoint("DELETE", "jobs/{}")
CANCEL = Endpoint("POST", "jobs/{}:cancel")
RESUME = Endpoint("POST", "jobs/{}:resume")
CLONE = Endpoint("POST", "jobs/{}:clone")
EVENTS = Endpoint("GET", "jobs/{}/events")
REPORT = Endpoint("GET", "jobs/{}/report")
RUNS = Endpoint("GET", "jobs/{}/runs")
SUMMARY = Endpoint("GET", "jobs/{}/summary")
TREND = Endpoint("GET", "jobs/{}/trend")

RUN = Endpoint("GET", "runs/{}")
EDIT_RUN = Endpoint("PATCH", "runs/{}")
DELETE_RUN = Endpoint("DELETE", "runs/{}")
HISTORY = Endpoint("GET", "runs/{}/history")
RESPONSE = Endpoint("GET", "runs/{}/response")
SIMULATE_RUN = Endpoint("POST", "runs/{}:simulate")
VALIDATE_RUN = Endpoint("POST", "runs/{}:validate")
MIGRATIONS = Endpoint("GET", "runs/{}/migrations")
PROFILE = Endpoint("POST", "runs/{}:profile")
RESIDUALS = Endpoint("GET", "runs/{}/residuals")
EXPORT = Endpoint("GET", "runs/{}/export")
COMPARE = Endpoint("POST", "runs:compare")

REFERENCES = Endpoint("GET", "references")
REFERENCE = Endpoint("GET", "references/{}")
ACCEPT_REFERENCE = Endpoint("PUT", "references/{}")
EDIT_REFERENCE = Endpoint("PATCH", "references/{}")
DELETE_REFERENCE = Endpoint("DELETE", "references/{}")


def build_edit(
    endpoint: Endpoint, name: str, changes: Mapping[str, Any], if_match: str | None
) -> RestCall:
    """Build a call that changes name, note or tags, by `if_match` only of that version."""
    headers = {} if if_match is None else {"If-Match": if_match}
    return replace(endpoint(name, json=changes), headers=headers)


def build_deletion(endpoint: Endpoint, name: str, cascade: bool) -> RestCall:
    """Build a call that deletes an item, by `cascade` with everything that was made from it."""
    return endpoint(name, cascade=True) if cascade else endpoint(name)


def build_submission(endpoint: Endpoint, body: Mapping[str, Any], key: str | None) -> RestCall:
    """Build a call that queues a job; the same idempotency key again returns the same job.

    Without a key the call gets a random one, so that it can be repeated if no response came.
    """
    return replace(endpoint(json=body), headers={IDEMPOTENCY_HEADER: key or uuid4().hex})


def build_event_stream(job: str, after: str | None) -> RestCall:
    """Build the call for a job's events, or for those after an event."""
    return replace(EVENTS(job), headers={"Last-Event-ID": after} if after else {})


def build_download(dataset: str, file_format: str) -> RestCall:
    """Build the call that downloads a dataset as ``mcap`` or ``csv``."""
    return (CONTENT_CSV if file_format == "csv" else CONTENT)(dataset)


def build_upload(
    source: str | Path | bytes, name: str | None, segments: str | None, sample_time: float | None
) -> RestCall:
    """Build the call that stores a file or bytes."""
    content = source if isinstance(source, bytes) else Path(source)
    kind = FILE_TYPE
    if isinstance(content, Path):
        kind = MCAP_TYPE if content.suffix.lower() == ".mcap" else FILE_TYPE
        name = name or content.name.removesuffix(".gz").rpartition(".")[0] or content.name
    call = ADD_DATASET(name=name, segments=segments, sample_time=sample_time)
    return replace(call, content=content, headers={"content-type": kind})


class Paginator:
    """Reads a list page by page: `at_most` items, or all."""

    def __init__(self, call: RestCall, at_most: int | None) -> None:
        self._call, self._left, self._limit = call, at_most, min(at_most or PAGE_SIZE, PAGE_SIZE)
        self._cursor: str | None = None
        self._is_over = False

    def next_call(self) -> RestCall | None:
        """Return the call of the next page; None after the last page."""
        if self._is_over:
            return None
        position = {"cursor": self._cursor} if self._cursor else {}
        params = {**self._call.params, "limit": self._limit, **position}
        return replace(self._call, params=params)

    def take_items(self, page: Document) -> list[Document]:
        """Return the items of a page and remember its cursor."""
        items: list[Document] = page["items"][: self._left]
        if self._left is not None:
            self._left -= len(items)
        self._cursor = page["next"]
        self._is_over = self._cursor is None or self._left == 0
        return items


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
    """Parses server-sent events line by line."""

    def __init__(self) -> None:
        self._fields: dict[str, str] = {}

    def feed_line(self, line: str) -> Iterator[Document]:
        """Take one line; yield the event that it completes, with its data decoded from JSON."""
        if line:
            key, _, value = line.partition(":")
            if key:  # a line that begins with a colon is a comment that keeps the line open
                self._fields[key] = value.removeprefix(" ")
            return
        fields, self._fields = self._fields, {}
        if "data" in fields:
            yield {
                "id": fields.get("id"),
                "event": fields.get("event", "message"),
                "data": json.loads(fields["data"]),
            }


def _describe_fault(entry: Mapping[str, Any]) -> str:
    column = f", column {entry['column']}" if entry.get("column") is not None else ""
    return f"{entry.get('pointer') or 'body'}{column}: {entry.get('detail')}"


DEFAULT_RETRIES = 4
FIRST_PAUSE_SECONDS = 0.5
"""Pause before the second attempt, if the server names none; it doubles with each attempt."""
MAX_PAUSE_SECONDS = 30.0
"""Longest pause. If the server asks for a longer one, the call is not repeated."""
REPEATABLE_METHODS = frozenset({"GET", "HEAD", "PUT"})


def plan_pauses(call: RestCall, retries: int) -> "Iterator[float]":
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
        Only status 503 is temporary. Its ``Retry-After`` sets the pause, in seconds or as a date
        (RFC 9110, section 10.2.3).
    pauses : iterator of float
        The remaining pauses of this call; one is taken.
    """
    if response.status_code != HTTPStatus.SERVICE_UNAVAILABLE:
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
