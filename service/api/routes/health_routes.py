"""Routes for health checks and Prometheus metrics."""

from collections.abc import Iterator
from typing import Literal

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse, Response
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from pydantic import Field
from sqlalchemy.exc import SQLAlchemyError

from service.api.queue_metrics import write_metrics
from service.api.requests.dependencies import Parts, PartsDep
from service.core.bodies.wire import Answer
from service.core.errors import FieldError, Unavailable
from service.queue.dispatchers import DispatcherRepository
from service.storage import migrate
from service.storage.storage_errors import DatabaseNotAtHead

router = APIRouter(tags=["health"])

PROBLEM_KINDS = {
    "foreign-origin": "A page of another origin sent a request that changes something. "
    "Use the service's own pages, or a program.",
    "out-of-scope": "The API key is valid, but does not allow this request. Use a key with the "
    "scope that the message names.",
    "quota": "The project stores as many bytes, or made as many evaluations in a day, as it may. "
    "Retry-After says when to try again. `GET /v1/access` shows limits and use.",
    "unauthorized": "The request has no valid API key. Send `Authorization: Bearer lagid_…`, or "
    "sign in at /sign-in.",
    "conflict": "The current state of the job does not allow this request.",
    "damaged-object": "Stored bytes of a recording or of signals have another checksum than when "
    "they were stored. That is the server's damage: its operator restores the object, or you store "
    "the same recording again.",
    "internal": "An unexpected error occurred. The server's log has the details.",
    "invalid": "The body or a query value is invalid. `errors` lists every fault. "
    "Type errors come first. Once all types are right, the answer lists the other faults.",
    "invalid-upload": "The file cannot be read. The message says where and why.",
    "misdirected": "The Host header is none of the service's names. Use its address, or let its "
    "operator add the name to LAGID_ALLOWED_HOSTS.",
    "method-not-allowed": "The path exists, but not for this method.",
    "not-found": "The resource does not exist.",
    "range": "The byte range lies outside the content.",
    "stalled": "Nothing of the body arrived for too long. Send it again.",
    "stale": "The resource has changed since it was read.",
    "too-large": "The body is larger than the stated limit.",
    "too-much-unfinished": "The project has reached its limit of unfinished jobs or runs. "
    "Try again later.",
    "unavailable": "A part of the service is down.",
    "unsupported-media-type": "The content type of the body is not supported.",
}


class HealthOut(Answer):
    """The web process answers."""

    status: Literal["ok"] = Field(default="ok", description="always ok: else there is no answer")


class ReadyOut(Answer):
    """Every part of the service works."""

    database: Literal["ok"] = Field(default="ok", description="its tables are of this version")
    store: Literal["ok"] = Field(default="ok", description="objects can be written")
    dispatcher: Literal["ok"] = Field(default="ok", description="at least one claims jobs")


@router.head("/healthz", include_in_schema=False)
@router.get("/healthz")
def check_alive() -> HealthOut:
    """Confirm that the web process answers."""
    return HealthOut()


@router.head("/readyz", include_in_schema=False)
@router.get("/readyz")
def check_ready(parts: PartsDep) -> ReadyOut:
    """Check that the database is at head, the store writable, and a dispatcher alive; else 503.

    It needs no key. So it tells nothing of addresses, and writes to the store now and then only.
    """
    failures = list(collect_failures(parts))
    if failures:
        detail = "; ".join(failure.detail for failure in failures)
        raise Unavailable(detail, failures)
    return ReadyOut()


@router.head("/metrics", include_in_schema=False, response_class=PlainTextResponse)
@router.get("/metrics", response_class=PlainTextResponse)
def read_metrics(parts: PartsDep) -> Response:
    """Read this process's numbers and those of the queue, in Prometheus' text format."""
    return Response(write_metrics(parts.database), media_type=CONTENT_TYPE_PLAIN_0_0_4)


@router.get("/problems/{kind}", response_class=PlainTextResponse, include_in_schema=False)
def explain_problem(kind: str) -> str:
    """Explain the `type` of a problem document."""
    return PROBLEM_KINDS.get(kind, "This server has no problem of that type.")


def collect_failures(parts: Parts) -> Iterator[FieldError]:
    """Check every part of the service, and yield what fails at its pointer."""
    if not parts.probe.is_writable():
        yield FieldError("/store", "store: objects cannot be written")
    try:
        migrate.check_revision(parts.database)
        with parts.database.read_session() as session:
            wait = DispatcherRepository(session).describe_wait()
    except SQLAlchemyError:
        yield FieldError("/database", "database: unreachable")
    except DatabaseNotAtHead as error:
        yield FieldError("/database", str(error))
    else:
        if wait is not None:
            yield FieldError("/dispatcher", wait)
