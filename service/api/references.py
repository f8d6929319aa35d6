"""Routes of references."""

from fastapi import APIRouter

from service.api.bodies import JsonRoute
from service.api.dependencies import Cursor, Limit, ReadSession, WriteSession
from service.jobs import references
from service.jobs.schemas import ReferenceIn, ReferenceOut, ReferencePage

reference_router = APIRouter(prefix="/v1/references", tags=["references"], route_class=JsonRoute)


@reference_router.get("")
def list_references(
    session: ReadSession, cursor: Cursor = None, limit: Limit = 50
) -> ReferencePage:
    """List the current references by name."""
    return references.list_references(session, cursor, limit)


@reference_router.get("/{name:path}")
def read_reference(name: str, session: ReadSession) -> ReferenceOut:
    """Read a reference: the accepted run, its estimates, and previously accepted runs."""
    return references.get_reference(session, name)


@reference_router.put("/{name:path}")
def accept_reference(name: str, body: ReferenceIn, session: WriteSession) -> ReferenceOut:
    """Accept a run as the reference of this name; the previous run stays in the history."""
    return references.accept_reference(session, name, body)
