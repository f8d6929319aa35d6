"""Whether the service is well: for people, supervisors and Prometheus."""

from collections.abc import Callable, Iterator, Mapping

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse
from sqlalchemy.exc import SQLAlchemyError

from service.api.dependencies import Parts, PartsDep, ReadSession
from service.core.errors import FieldError, Unavailable
from service.queue.dispatchers import DispatcherRepository
from service.repositories.jobs import JobRepository
from service.storage import migrate
from service.storage.errors import StorageError

router = APIRouter(tags=["health"])

PROBLEM_KINDS = {
    "conflict": "The state of the job does not allow what was asked.",
    "internal": "An unexpected error; the log of the server has it.",
    "invalid": "The body or a query value cannot be used; `errors` lists every fault. "
    "Faults of types come first; once all types are right, the answer lists all others.",
    "invalid-upload": "The file cannot be used; the message says where and why.",
    "method-not-allowed": "The path exists, but not for this method.",
    "not-found": "There is no such thing.",
    "range": "The byte range lies outside the content.",
    "stale": "The thing has changed since it was read.",
    "too-large": "The body is larger than the stated limit.",
    "unavailable": "A part of the service is down.",
    "unsupported-media-type": "The body is of a kind that is not read.",
}


@router.get("/healthz")
def check_alive() -> dict[str, str]:
    """The web process answers."""
    return {"status": "ok"}


@router.get("/readyz")
def check_ready(parts: PartsDep) -> dict[str, str]:
    """Database at head, store writable, a dispatcher alive; 503 with what is not."""
    checks = {"database": _check_database, "store": _check_store, "dispatcher": _check_dispatcher}
    failures = list(_collect_failures(parts, checks))
    if failures:
        detail = "; ".join(one.detail for one in failures)
        raise Unavailable(detail, failures)
    return dict.fromkeys(checks, "ok")


@router.get("/metrics", response_class=PlainTextResponse)
def read_metrics(session: ReadSession) -> str:
    """Gauges in Prometheus' text format."""
    alive_now = len(DispatcherRepository(session).list_alive())
    lines = ["# HELP lagid_jobs Jobs by state.", "# TYPE lagid_jobs gauge"]
    for state, n in JobRepository(session).count_states().items():
        lines.append(f'lagid_jobs{{state="{state.value}"}} {n}')
    lines += [
        "# HELP lagid_dispatchers Dispatchers that are alive.",
        "# TYPE lagid_dispatchers gauge",
        f"lagid_dispatchers {alive_now}",
    ]
    return "\n".join(lines) + "\n"


@router.get("/problems/{kind}", response_class=PlainTextResponse, include_in_schema=False)
def explain_problem(kind: str) -> str:
    """What a problem document's `type` means."""
    return PROBLEM_KINDS.get(kind, "This server gives no problem of that type.")


def _collect_failures(
    parts: Parts, checks: Mapping[str, Callable[[Parts], None]]
) -> Iterator[FieldError]:
    for name, check in checks.items():
        try:
            check(parts)
        except (StorageError, SQLAlchemyError, Unavailable) as error:
            yield FieldError(f"/{name}", str(error).splitlines()[0])


def _check_database(parts: Parts) -> None:
    migrate.check_revision(parts.database)


def _check_store(parts: Parts) -> None:
    parts.store.check_writable()


def _check_dispatcher(parts: Parts) -> None:
    with parts.database.read_session() as session:
        if not DispatcherRepository(session).list_alive():
            raise Unavailable("no dispatcher is alive; jobs are accepted, and wait for one")
