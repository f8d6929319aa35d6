"""Use cases of references: accept a run under a name, read references, resolve a warm start."""

from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest
from service.core.states import JobState
from service.items.reference_names import REFERENCE_PREFIX, check_reference_name, find_name_fault
from service.jobs.job_schemas import ReferenceIn, ReferenceOut, ReferencePage
from service.jobs.stored_run import load_run
from service.models.models import have_same_equations
from service.repositories.job_rows import JobRepository
from service.repositories.reference_rows import CurrentReference, ReferenceRepository
from service.repositories.run_rows import RunRepository
from service.repositories.search_conditions import NO_FILTER, ListFilter
from service.storage.storage_errors import InvalidCursor, RowNotFound
from service.storage.tables import AcceptedReference, Run
from sysid.core.errors import suggest_name


def accept_reference(session: Session, name: str, body: ReferenceIn) -> ReferenceOut:
    """Make a run the reference of a name.

    Raises
    ------
    InvalidRequest
        If the name is invalid or stands for another model, or if there is no such successful run.
    """
    check_reference_name(name, "{name}")
    run = _get_succeeded_run(session, body.run, "/run")
    JobRepository(session).share_lock(run.job_id)
    run = _get_succeeded_run(session, body.run, "/run")  # it is not deleted from now on
    _check_model(session, name, run)
    ReferenceRepository(session).accept_run(name, run.id, body.by, body.note)
    return get_reference(session, name)


def get_reference(session: Session, name: str) -> ReferenceOut:
    """Read a reference with its history. `RowNotFound` suggests the nearest name."""
    repository = ReferenceRepository(session)
    try:
        latest, *before = repository.list_history(name)
    except RowNotFound:
        raise RowNotFound("reference", f"{name!r}{_suggest_name(session, name)}") from None
    run = RunRepository(session).get(latest.run_id)
    return _to_reference_out(
        CurrentReference(latest, run.job_id, run.labels, run.estimates), before
    )


def list_references(
    session: Session, cursor: str | None, limit: int, chosen: ListFilter = NO_FILTER
) -> ReferencePage:
    """List the references in use that meet a filter, by name."""
    if cursor is not None and find_name_fault(cursor) is not None:
        raise InvalidCursor(cursor)
    page = ReferenceRepository(session).list_page(cursor=cursor, limit=limit, chosen=chosen)
    return ReferencePage(
        items=[_to_reference_out(reference, []) for reference in page.items], next=page.next
    )


def resolve_reference(session: Session, reference: str, pointer: str = "/warm_start") -> Run:
    """Find the run that ``run_…`` or ``reference:name`` means.

    Raises
    ------
    InvalidRequest
        At the pointer, if there is no such run, or it did not succeed.
    """
    named = reference.removeprefix(REFERENCE_PREFIX)
    if named == reference:
        return _get_succeeded_run(session, reference, pointer)
    try:
        latest = ReferenceRepository(session).get_latest(named)
    except RowNotFound:
        raise InvalidRequest.from_fault(
            pointer,
            f"there is no reference {named!r}{_suggest_name(session, named)}. Accept a run "
            "under this name first",
        ) from None
    return _get_succeeded_run(session, latest.run_id, pointer)


def _check_model(session: Session, name: str, run: Run) -> None:
    """Refuse a run of another model than that of the name."""
    try:
        latest = ReferenceRepository(session).get_latest(name)
    except RowNotFound:
        return
    before = load_run(session, latest.run_id).model_of_request
    new = load_run(session, run.id).model_of_request
    if not have_same_equations(before, new):
        raise InvalidRequest.from_fault(
            "/run",
            f"run {run.id} has the model {new.name!r}, but {name!r} stands for the model "
            f"{before.name!r} (now run {latest.run_id}). Accept it under another name",
        )


def _get_succeeded_run(session: Session, run_id: str, pointer: str) -> Run:
    try:
        run = RunRepository(session).get(run_id)
    except RowNotFound as error:
        raise InvalidRequest.from_fault(pointer, str(error)) from None
    if run.state is not JobState.SUCCEEDED or run.estimates is None:
        raise InvalidRequest.from_fault(
            pointer, f"run {run_id} is {run.state.value}; need a run that succeeded"
        )
    return run


def _suggest_name(session: Session, name: str) -> str:
    return suggest_name(name, ReferenceRepository(session).list_names())


def _to_reference_out(current: CurrentReference, before: list[AcceptedReference]) -> ReferenceOut:
    latest, *earlier = (
        {"run": row.run_id, "by": row.accepted_by, "note": row.note, "at": row.accepted_at}
        for row in (current.accepted, *before)
    )
    return ReferenceOut.model_validate(
        {
            **latest,
            "name": current.accepted.name,
            "job": current.job_id,
            "tags": current.accepted.tags or [],
            "labels": current.labels,
            "estimates": current.estimates or {},
            "history": earlier,
        }
    )
