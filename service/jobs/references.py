"""Use cases of references: accept a run under a name, read them, find the run to start from."""

from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest
from service.core.wire import Page
from service.jobs.schemas import REFERENCE, RUN, ReferenceIn, ReferenceOut
from service.jobs.stored_run import load_run
from service.models.models import says_the_same
from service.repositories.references import InUse, ReferenceRepository
from service.repositories.runs import RunRepository
from service.storage.errors import NotFound
from service.storage.tables import AcceptedReference, Run, State
from sysid.core.errors import nearest

MOST_NAME = 100


def accept(session: Session, name: str, body: ReferenceIn) -> ReferenceOut:
    """Make a run the reference of a name.

    Raises
    ------
    InvalidRequest
        If the name cannot be used, or there is no such run, or it did not succeed, or the name
        stands for another model.
    """
    _check_name(name)
    run = _succeeded(session, body.run, "/run")
    _check_model(session, name, run)
    ReferenceRepository(session).accept(name, run.id, body.by, body.note)
    return one(session, name)


def one(session: Session, name: str) -> ReferenceOut:
    """A reference with its history; `NotFound` with the nearest name."""
    repository = ReferenceRepository(session)
    try:
        latest, *before = repository.history(name)
    except NotFound:
        raise NotFound("reference", f"{name!r}{_nearest(session, name)}") from None
    run = RunRepository(session).get(latest.run_id)
    return _told(InUse(latest, run.job_id, run.labels, run.estimates), before)


def page(session: Session, cursor: str | None, limit: int) -> Page[ReferenceOut]:
    """References in use, by name."""
    found = ReferenceRepository(session).page(cursor=cursor, limit=limit)
    return Page(items=[_told(one, []) for one in found.items], next=found.next)


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
        latest = ReferenceRepository(session).latest(named)
    except NotFound:
        raise InvalidRequest.at(
            pointer, f"there is no reference {named!r}{_nearest(session, named)}; accept a run "
            "under this name first",
        ) from None  # fmt: skip
    return _succeeded(session, latest.run_id, pointer)


def _check_name(name: str) -> None:
    """Refuse names that could not be told from a run, or from the parts of a path."""
    if not 1 <= len(name) <= MOST_NAME or not name.isprintable() or name != name.strip():
        wanted = f"1 to {MOST_NAME} printable characters, no blank at an end"
    elif name.startswith((RUN, REFERENCE)):
        wanted = f"one that does not begin with {RUN!r} (a run's id does) or {REFERENCE!r}"
    elif "/" in name or not name.strip("."):
        wanted = "one without '/', and not of dots only"
    else:
        return
    raise InvalidRequest.at("{name}", f"the name in the path: found {name!r:.120}; need {wanted}")


def _check_model(session: Session, name: str, run: Run) -> None:
    """Refuse a run of another model than the one that a name stands for."""
    try:
        latest = ReferenceRepository(session).latest(name)
    except NotFound:
        return
    before = load_run(session, latest.run_id).requested_model
    new = load_run(session, run.id).requested_model
    if not says_the_same(before, new):
        raise InvalidRequest.at(
            "/run",
            f"run {run.id} is of the model {new.name!r}, and {name!r} stands for runs of another, "
            f"{before.name!r} (now {latest.run_id}); accept it under a name of its own",
        )


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
    return nearest(name, ReferenceRepository(session).names())


def _told(one: InUse, before: list[AcceptedReference]) -> ReferenceOut:
    latest, *earlier = (
        {"run": row.run_id, "by": row.accepted_by, "note": row.note, "at": row.accepted_at}
        for row in (one.accepted, *before)
    )
    return ReferenceOut.model_validate(
        {
            **latest,
            "name": one.accepted.name,
            "job": one.job_id,
            "labels": one.labels,
            "estimates": one.estimates or {},
            "history": earlier,
        }
    )
