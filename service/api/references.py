"""Routes of references."""

from fastapi import APIRouter

from service.api.dependencies import Cursor, Limit, ReadSession, WriteSession
from service.core.wire import Page
from service.jobs import references
from service.jobs.schemas import ReferenceIn, ReferenceOut

reference_router = APIRouter(prefix="/v1/references", tags=["references"])


@reference_router.get("")
def list_references(
    session: ReadSession, cursor: Cursor = None, limit: Limit = 50
) -> Page[ReferenceOut]:
    """References in use, by name."""
    return references.list_references(session, cursor, limit)


@reference_router.get("/{name:path}")
def read_reference(name: str, session: ReadSession) -> ReferenceOut:
    """One reference: the run in use, its estimates, and what was accepted before."""
    return references.get_reference(session, name)


@reference_router.put("/{name:path}")
def accept_reference(name: str, body: ReferenceIn, session: WriteSession) -> ReferenceOut:
    """Accept a run as the reference of this name; the one before stays in the history."""
    return references.accept_reference(session, name, body)
