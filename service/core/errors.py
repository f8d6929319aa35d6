"""Every error the service raises on purpose, each with its HTTP status.

* ServiceError
    - Unauthorized           401  the request has no valid API key
    - ForeignOrigin          403  a page of another origin sent a request that changes something
    - OutOfScope             403  the API key does not allow this request
    - NotFound               404  the dataset, model, job or run does not exist
    - StalledRequest         408  the sender of a body stopped or was too slow
    - Conflict               409  the state of the resource does not allow the request
    - StaleVersion           412  a precondition (If-Match) does not hold
    - TooLarge               413  the body exceeds a limit
    - UnsupportedMediaType   415  the media type of the body is not supported
    - UnsatisfiableRange     416  a byte range outside the content
    - MisdirectedRequest     421  the Host header names another server
    - InvalidRequest         422  the body or a query value is invalid; lists every fault
        - InvalidUpload           an uploaded file cannot be used
    - QuotaExceeded          429  the project has reached its limit of unfinished work
        - BudgetExceeded          or its limit of stored bytes or of evaluations in a day
    - DamagedObject          500  the bytes of a stored object have changed
    - Unavailable            503  a component of the service is down
        - ServiceBusy             too many heavy requests
    - Misconfigured               the settings are invalid (command line only)
    - ServiceDidNotStart          `lagid serve` ended or was not ready in time (command line only)

One handler (`service.api.requests.problems`) builds the RFC 9457 problem document. This module
imports no heavy library, so that the light client can use it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import ceil
from typing import Any, ClassVar

from sysid.core.errors import (
    InvalidBounds,
    InvalidModel,
    InvalidSettings,
    SysidError,
    UnknownModel,
    UnreadableFile,
)


@dataclass(frozen=True, slots=True)
class FieldError:
    """One fault of a request.

    Attributes
    ----------
    pointer : str
        JSON pointer into the body, such as ``/algorithm/population``. ``?name`` is a query value,
        ``{name}`` a part of the path.
    detail : str
        What was wrong, which value was received, what would be right.
    column : int or None
        Column (from 1) inside the text of the field, for equations.
    option : str or None
        Option of the request that the detail advises at its end, such as ``sample_time``.
    """

    pointer: str
    detail: str
    column: int | None = None
    option: str | None = None

    def __str__(self) -> str:
        return f"{self.pointer}: {self.detail}" if self.pointer else self.detail

    def to_dict(self) -> dict[str, Any]:
        """Return the fault as an entry of a problem document's ``errors``."""
        entry: dict[str, Any] = {"pointer": self.pointer, "detail": self.detail}
        others = {"column": self.column, "option": self.option}
        return entry | {name: value for name, value in others.items() if value is not None}


class ServiceError(Exception):
    """Base class of the errors that the service raises on purpose."""

    status: ClassVar[int] = 500
    kind: ClassVar[str] = "internal"
    title: ClassVar[str] = "The service failed"

    def __init__(self, detail: str, errors: Iterable[FieldError] = ()) -> None:
        super().__init__(detail)
        self.detail = detail
        self.errors = tuple(errors)

    @property
    def headers(self) -> Mapping[str, str]:
        """Headers that the response carries in addition to the document."""
        return {}

    @property
    def members(self) -> Mapping[str, Any]:
        """Members that the problem document has in addition."""
        return {}


class ForeignOrigin(ServiceError):
    """A page of another origin sent a request that changes something."""

    status, kind, title = 403, "foreign-origin", "Not allowed from another origin"


class Unauthorized(ServiceError):
    """The request has no valid API key.

    Attributes
    ----------
    is_wrong : bool
        Whether it has one that is not valid.
    key_id : str or None
        The key that it names.
    """

    status, kind, title = 401, "unauthorized", "A valid API key is needed"

    def __init__(self, detail: str, *, is_wrong: bool = False, key_id: str | None = None) -> None:
        super().__init__(detail)
        self.is_wrong, self.key_id = is_wrong, key_id

    @property
    def headers(self) -> Mapping[str, str]:
        """How to authenticate (RFC 6750)."""
        error = ', error="invalid_token"' if self.is_wrong else ""
        return {"WWW-Authenticate": f'Bearer realm="lagid"{error}'}


class OutOfScope(ServiceError):
    """The API key does not allow this request."""

    status, kind, title = 403, "out-of-scope", "The API key does not allow this"


class NotFound(ServiceError):
    """The dataset, model, job or run does not exist."""

    status, kind, title = 404, "not-found", "Not found"

    def __init__(self, what: str, name: str, hint: str = "") -> None:
        super().__init__(f"there is no {what} {name!r}{hint}")
        self.what, self.name = what, name


class DatasetNotFound(ServiceError):
    """No dataset has that identifier or name, or several share the name; the text says which."""

    status, kind, title = 404, "not-found", "Not found"


class StalledRequest(ServiceError):
    """The sender of a body stopped, or was too slow."""

    status, kind, title = 408, "stalled", "The body did not arrive"


class Conflict(ServiceError):
    """The state of the resource does not allow the request."""

    status, kind, title = 409, "conflict", "Conflict with the current state"


class StaleVersion(ServiceError):
    """A precondition does not hold: the resource has changed since it was read."""

    status, kind, title = 412, "stale", "The resource has changed since it was read"


class TooLarge(ServiceError):
    """The body exceeds a limit."""

    status, kind, title = 413, "too-large", "The body is too large"


class UnsupportedMediaType(ServiceError):
    """The media type of the body is not supported."""

    status, kind, title = 415, "unsupported-media-type", "Unsupported media type"


class UnsatisfiableRange(ServiceError):
    """A byte range that lies outside the content."""

    status, kind, title = 416, "range", "The byte range lies outside the content"

    def __init__(self, requested: str, size: int) -> None:
        super().__init__(f"the range {requested!r} lies outside the {size} bytes")
        self.size = size

    @property
    def headers(self) -> Mapping[str, str]:
        """The length of the content, as RFC 9110 requires."""
        return {"Content-Range": f"bytes */{self.size}"}


class MisdirectedRequest(ServiceError):
    """The Host header names another server."""

    status, kind, title = 421, "misdirected", "The request is meant for another server"


class InvalidRequest(ServiceError):
    """The body or a query value is invalid."""

    status, kind, title = 422, "invalid", "The request is invalid"

    def __init__(self, errors: Iterable[FieldError]) -> None:
        faults = tuple(errors)
        super().__init__("; ".join(map(str, faults)), faults)

    @classmethod
    def from_fault(cls, pointer: str, detail: str) -> "InvalidRequest":
        """Return the error of a request with one fault."""
        return cls((FieldError(pointer, detail),))


class InvalidUpload(InvalidRequest):
    """An uploaded file cannot be used."""

    kind, title = "invalid-upload", "The file cannot be used"

    def __init__(self, error: UnreadableFile) -> None:
        super().__init__(to_field_errors(error))
        self.detail = error.detail


class QuotaExceeded(ServiceError):
    """The project has reached its limit of queued and running work."""

    status, kind, title = 429, "too-much-unfinished", "The project has too much unfinished work"

    @property
    def headers(self) -> Mapping[str, str]:
        """When to try again, in seconds."""
        return {"Retry-After": "10"}


class BudgetExceeded(QuotaExceeded):
    """The project has reached its limit of stored bytes or of evaluations in a day."""

    kind, title = "quota", "The project has used up its quota"

    def __init__(self, detail: str, retry_seconds: float) -> None:
        super().__init__(detail)
        self._retry_seconds = retry_seconds

    @property
    def headers(self) -> Mapping[str, str]:
        """When to try again, in seconds."""
        return {"Retry-After": str(max(1, ceil(self._retry_seconds)))}


class Unavailable(ServiceError):
    """A component that the service needs is down."""

    status, kind, title = 503, "unavailable", "A part of the service is down"

    @property
    def headers(self) -> Mapping[str, str]:
        """When to ask again, in seconds."""
        return {"Retry-After": "1"}


class DamagedObject(ServiceError):
    """The bytes of a stored object have changed: the server's damage, and no fault of a request."""

    status, kind, title = 500, "damaged-object", "A stored object is damaged"


class ServiceBusy(Unavailable):
    """Too many heavy requests run at once."""

    title = "The service is busy"

    @property
    def headers(self) -> Mapping[str, str]:
        """When to ask again, in seconds."""
        return {"Retry-After": "2"}


class Misconfigured(ServiceError):
    """The settings are invalid."""

    kind, title = "misconfigured", "The settings cannot be used"


class ServiceDidNotStart(ServiceError):
    """A service that was started as a child ended, or was not ready in time."""

    kind, title = "did-not-start", "The service did not start"

    def __init__(self, reason: str, log: str = "") -> None:
        super().__init__(f"the service did not start: {reason}" + (f"\n{log}" if log else ""))
        self.reason, self.log = reason, log


def to_field_errors(error: SysidError) -> list[FieldError]:
    """Convert an error of the numerical core into faults of a job or model document."""
    match error:
        case InvalidModel():
            return [FieldError(f.pointer, f.detail, f.column) for f in error.faults]
        case InvalidSettings():
            return [FieldError(error.pointer, error.detail)]
        case UnreadableFile():
            option = error.advice and error.advice.option
            return [FieldError(error.pointer, error.detail, option=option or None)]
        case InvalidBounds():
            return [FieldError(f"/parameters/{error.name}", str(error))]
        case UnknownModel():
            return [FieldError("/model", str(error))]
    return [FieldError("", str(error))]
