"""Use cases of references: accept a run under a name, read them, find the run to start from."""

from typing import Any

from sqlalchemy.orm import Session

from service.errors import InvalidRequest
from service.schemas_jobs import REFERENCE
from service.schemas_references import AcceptedOut, ReferenceIn, ReferenceOut, ReferencesOut
from service.storage.errors import NotFound
from service.storage.references import ReferenceRepository
from service.storage.runs import RunRepository
from service.storage.tables import AcceptedReference, Run, State
from sysid.errors import nearest

MOST_NAME = 100


def accept(session: Session, name: str, body: ReferenceIn) -> ReferenceOut:
    """Make a run the reference of a name.

    Raises
    ------
    InvalidRequest
        If the name cannot be used, or there is no such run, or it did not succeed.
    """
    if not 1 <= len(name) <= MOST_NAME or not name.isprintable() or name != name.strip():
        raise InvalidRequest.at(
            "?name",
            f"found {name!r:.120}; need 1 to {MOST_NAME} printable characters, no blank at an end",
        )
    run = _succeeded(session, body.run, "/run")
    ReferenceRepository(session).accept(name, run.id, body.by, body.note)
    return one(session, name)


def one(session: Session, name: str) -> ReferenceOut:
    """A reference with its history; `NotFound` with the nearest name."""
    repository = ReferenceRepository(session)
    try:
        latest, *before = repository.history(name)
    except NotFound:
        raise NotFound("reference", f"{name!r}{_nearest(session, name)}") from None
    return _told(session, latest, before)


def page(session: Session) -> ReferencesOut:
    """All references in use, by name."""
    found = ReferenceRepository(session).all()
    return ReferencesOut(items=[_told(session, one, []) for one in found])


def run_of(session: Session, reference: str, pointer: str = "/warm_start") -> Run:
    """The run that ``run_…`` or ``reference:name`` means.

    Raises
    ------
    InvalidRequest
        At the pointer, if there is none, or it did not succeed.
    """
    named = reference.removeprefix(REFERENCE)
    if named == reference:
        return _succeeded(session, reference, pointer)
    try:
        latest, *_ = ReferenceRepository(session).history(named)
    except NotFound:
        raise InvalidRequest.at(
            pointer, f"there is no reference {named!r}{_nearest(session, named)}; accept a run "
            "under this name first",
        ) from None  # fmt: skip
    return _succeeded(session, latest.run_id, pointer)


def _succeeded(session: Session, run_id: str, pointer: str) -> Run:
    try:
        run = RunRepository(session).get(run_id)
    except NotFound as error:
        raise InvalidRequest.at(pointer, str(error)) from None
    if run.state is not State.SUCCEEDED or run.estimates is None:
        raise InvalidRequest.at(
            pointer, f"run {run_id} is {run.state.value}; need one that succeeded"
        )
    return run


def _nearest(session: Session, name: str) -> str:
    return nearest(name, [one.name for one in ReferenceRepository(session).all()])


def _told(
    session: Session, latest: AcceptedReference, before: list[AcceptedReference]
) -> ReferenceOut:
    run = RunRepository(session).get(latest.run_id)
    estimates: dict[str, Any] = run.estimates or {}
    return ReferenceOut(
        name=latest.name, run=run.id, job=run.job_id, by=latest.accepted_by, note=latest.note,
        at=latest.accepted_at, labels=run.labels, estimates=estimates,
        history=[
            AcceptedOut(run=one.run_id, by=one.accepted_by, note=one.note, at=one.accepted_at)
            for one in before
        ],
    )  # fmt: skip
