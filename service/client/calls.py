"""The REST calls as values, shared by the synchronous and the asynchronous client.

Whether a call that a server could not serve just now is sent again, and after what pause.
"""

import json
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http import HTTPStatus
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias, TypedDict
from uuid import uuid4

from service.core.states import State

if TYPE_CHECKING:
    import httpx


Document: TypeAlias = dict[str, Any]

DEFAULT_URL = "http://127.0.0.1:8000"
TERMINAL = frozenset(state.value for state in State if state.is_terminal)
PIECE = 1 << 20
MCAP_MAGIC = b"\x89MCAP0\r\n"
MEDIA_TYPES = {".csv": "text/csv", ".txt": "text/csv", ".mcap": "application/x-mcap"}
IDEMPOTENCY = "Idempotency-Key"

POLL_S = 0.3
TIMEOUT_S = 60.0
PAGE = 500


class Options(TypedDict):
    """What both clients tell httpx."""

    base_url: str
    headers: dict[str, str]
    timeout: float


def options(url: str, key: str | None) -> Options:
    """The server's address and the key, as httpx takes them."""
    headers = {"Authorization": f"Bearer {key}"} if key else {}
    return Options(base_url=url, headers=headers, timeout=TIMEOUT_S)


class ClientError(Exception):
    """Base class of what a client raises on purpose.

    It is a ProblemError, a ServerUnreachable or a NotFinite.
    """


class ProblemError(ClientError):
    """The server refused a request.

    Attributes
    ----------
    status : int
    document : dict
        The RFC 9457 problem document; ``errors`` lists each fault with its JSON pointer.
    reason : str
        What it says, in one line.
    """

    def __init__(self, status: int, document: Document) -> None:
        self.status, self.document = status, document
        faults = [_fault(entry) for entry in document.get("errors", [])]
        self.reason = "; ".join(faults) or str(document.get("detail", ""))
        super().__init__(f"{document.get('title', 'error')} ({status}): {self.reason}")


class ServerUnreachable(ClientError):
    """No server answers at the address."""

    def __init__(self, url: str, reason: str) -> None:
        super().__init__(
            f"no lagid server answers at {url} ({reason}); start one with `lagid serve`, "
            "or name another with --url or LAGID_URL"
        )


class NotFinite(ClientError):
    """A body holds a number that JSON has no word for; it was not sent.

    Attributes
    ----------
    pointer : str
        Where it stands in the body.
    reason : str
        What was found there.
    """

    def __init__(self, pointer: str, value: float) -> None:
        self.pointer, self.reason = pointer, f"found {value}; need a finite number"
        super().__init__(f"{pointer or 'body'}: {self.reason}")


@dataclass(frozen=True, slots=True)
class Call:
    """One request, not yet sent.

    Raises
    ------
    NotFinite
        If a number of the body is infinite or not a number.
    """

    method: str
    path: str
    params: Mapping[str, Any] = field(default_factory=dict)
    json: Any = None
    content: bytes | Path | None = None
    headers: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_finite("", self.json)


def _check_finite(pointer: str, value: Any) -> None:
    if isinstance(value, float) and not isfinite(value):
        raise NotFinite(pointer, value)
    if isinstance(value, Mapping):
        for name, one in value.items():
            part = str(name).replace("~", "~0").replace("/", "~1")
            _check_finite(f"{pointer}/{part}", one)
    elif isinstance(value, list | tuple):
        for index, one in enumerate(value):
            _check_finite(f"{pointer}/{index}", one)


def read(*parts: str, **params: Any) -> Call:
    """GET of a path made of parts; parameters that are None are left out."""
    given = {name: value for name, value in params.items() if value is not None}
    return Call("GET", "/v1/" + "/".join(_quoted(part) for part in parts), given)


def act(what: str, name: str, verb: str, body: Any = None, **params: Any) -> Call:
    """POST of an action upon one thing, such as ``/v1/jobs/job_…:cancel``."""
    return Call("POST", f"/v1/{what}/{_quoted(name)}:{verb}", params, json=body)


def profile(run: str, parameters: Sequence[str], points: int) -> Call:
    """POST that asks for the profiles of a run's parameters, of all free ones if none is named."""
    names = list(parameters) or None
    return act("runs", run, "profile", {"parameters": names, "points": points})


def create(what: str, body: Any, headers: Mapping[str, str] | None = None) -> Call:
    """POST of a new thing."""
    return Call("POST", f"/v1/{what}", json=body, headers=headers or {})


def queue(what: str, body: Mapping[str, Any], key: str | None) -> Call:
    """POST that queues a job; the same idempotency key again gives the same job.

    Without a key it has one of its own, so that it can be sent again where no answer came.
    """
    return create(what, body, {IDEMPOTENCY: key or uuid4().hex})


def events(job: str, after: str | None) -> Call:
    """GET of a job's events, those after a known one."""
    call = read("jobs", job, "events")
    return replace(call, headers={"Last-Event-ID": after}) if after else call


def accept(name: str, run: str, by: str | None, note: str | None) -> Call:
    """PUT of a run as the reference of a name."""
    return Call("PUT", f"/v1/references/{_quoted(name)}", json={"run": run, "by": by, "note": note})


def upload(
    source: str | Path | bytes, name: str | None, segments: str | None, sample_time: float | None
) -> Call:
    """POST of a recording, from a file or from bytes; its kind follows from suffix or content."""
    content: bytes | Path
    if isinstance(source, bytes):
        content = source
        kind = "application/x-mcap" if content.startswith(MCAP_MAGIC) else "text/csv"
    else:
        content = Path(source)
        kind = MEDIA_TYPES.get(content.suffix.lower(), "application/octet-stream")
        name = name or content.stem
    given = {"name": name, "segments": segments, "sample_time": sample_time}
    params = {key: value for key, value in given.items() if value is not None}
    return Call("POST", "/v1/datasets", params, content=content, headers={"content-type": kind})


@contextmanager
def opened(content: bytes | Path | None) -> Iterator[bytes | BinaryIO | None]:
    """Content to send; a file is read piece by piece while it is sent."""
    if isinstance(content, Path):
        with content.open("rb") as file:
            yield file
    else:
        yield content


def pieces(content: bytes | Path | None) -> bytes | AsyncIterator[bytes] | None:
    """Content to send from an asynchronous client."""
    return _read_pieces(content) if isinstance(content, Path) else content


@contextmanager
def unreachable_told(url: str) -> Iterator[None]:
    """Raise `ServerUnreachable` where no answer comes."""
    import httpx  # whoever sends has a client; a command without one starts sooner

    try:
        yield
    except httpx.TransportError as error:
        raise ServerUnreachable(url, str(error) or type(error).__name__) from error


def request(call: Call, content: Any, *, stream: bool) -> dict[str, Any]:
    """A call as httpx builds a request of it; a stream stays open as long as it has to."""
    given = {"params": dict(call.params), "json": call.json, "headers": dict(call.headers)}
    limit = {"timeout": None} if stream else {}
    return {"method": call.method, "url": call.path, "content": content, **given, **limit}


class Pages:
    """What is listed under a path, page by page: `at_most` items, or all."""

    def __init__(
        self, parts: Sequence[str], at_most: int | None, filters: Mapping[str, Any]
    ) -> None:
        self._parts, self._filters = parts, filters
        self._left, self._limit = at_most, min(at_most or PAGE, PAGE)
        self._cursor: str | None = None
        self._is_over = False

    def next(self) -> Call | None:
        """The call of the next page, until there is none."""
        if self._is_over:
            return None
        return read(*self._parts, cursor=self._cursor, limit=self._limit, **self._filters)

    def take(self, page: Document) -> list[Document]:
        """The items of a page that answers the call."""
        found: list[Document] = page["items"][: self._left]
        if self._left is not None:
            self._left -= len(found)
        self._cursor = page["next"]
        self._is_over = self._cursor is None or self._left == 0
        return found


def checked(answer: "httpx.Response") -> "httpx.Response":
    """The answer, unless it is an error.

    Raises
    ------
    ProblemError
        With the problem document; one is made where something else than lagid answered.
    """
    if answer.is_success:
        return answer
    try:
        document = answer.json()
    except ValueError:
        document = None
    if not isinstance(document, dict):
        document = {"title": answer.reason_phrase, "status": answer.status_code,
                    "detail": answer.text[:200]}  # fmt: skip
    raise ProblemError(answer.status_code, document)


async def _read_pieces(path: Path) -> AsyncIterator[bytes]:
    import asyncio  # late, for commands that open no connection

    with path.open("rb") as file:
        while piece := await asyncio.to_thread(file.read, PIECE):
            yield piece


class EventParser:
    """Server-sent events from lines; `feed` gives an event when a line completes one."""

    def __init__(self) -> None:
        self._fields: dict[str, str] = {}

    def feed(self, line: str) -> Iterator[Document]:
        """Take one line; yield the event it completes, with its data decoded from JSON."""
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


def _fault(entry: Mapping[str, Any]) -> str:
    column = f", column {entry['column']}" if entry.get("column") is not None else ""
    return f"{entry.get('pointer') or 'body'}{column}: {entry.get('detail')}"


def _quoted(part: str) -> str:
    import httpx  # whoever quotes has a client; a command without one starts sooner

    return httpx.URL("/").copy_with(path="/" + part).raw_path.decode().removeprefix("/")


RETRIES = 4
FIRST_S = 0.5
"""Pause before the second try, where the server names none; each one after is twice as long."""
LONGEST_S = 30.0
"""No pause is longer: a server that asks for more is away for longer than a call should hang."""
REPEATABLE = frozenset({"GET", "HEAD", "PUT"})


def pauses(call: Call, retries: int) -> "Iterator[float]":
    """Seconds to wait before each further try of a call, where the server names none.

    There are none for a request that might be carried out twice: a POST without idempotency key.
    """
    if call.method in REPEATABLE or IDEMPOTENCY in call.headers:
        for number in range(retries):
            yield FIRST_S * 2**number


def pause_after(answer: "httpx.Response", left: "Iterator[float]") -> float | None:
    """Seconds until a call is sent again; None if its answer stands.

    Parameters
    ----------
    answer : httpx.Response
        Only 503 is temporary by its meaning; its ``Retry-After`` is waited for, in seconds or as
        a date (RFC 9110, section 10.2.3).
    left : iterator of float
        The pauses of this call that are left, of which one is taken.
    """
    if answer.status_code != HTTPStatus.SERVICE_UNAVAILABLE:
        return None
    pause = next(left, None)
    if pause is None:
        return None
    asked = _asked(answer.headers.get("Retry-After"))
    pause = pause if asked is None else asked
    return pause if pause <= LONGEST_S else None


def _asked(header: str | None) -> float | None:
    """Seconds that a ``Retry-After`` asks for; None if it is missing or neither of its forms."""
    if header is None:
        return None
    if header.strip().isdecimal():
        return float(header)
    try:
        until = parsedate_to_datetime(header)
    except (ValueError, OverflowError):  # the latter of a zone that no integer holds
        return None
    if until.tzinfo is None:  # RFC 5322's -0000; HTTP's dates are of GMT
        until = until.replace(tzinfo=UTC)
    return max(0.0, (until - datetime.now(UTC)).total_seconds())
