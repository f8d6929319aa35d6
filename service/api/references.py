"""Routes of references."""

from fastapi import APIRouter

from service.api.dependencies import Cursor, Limit, ReadSession, WriteSession
from service.core.wire import Page
from service.jobs import references
from service.jobs.schemas import ReferenceIn, ReferenceOut

router = APIRouter(prefix="/v1/references", tags=["references"])


@router.get("")
def page(
    session: ReadSession, cursor: Cursor = None, limit: Limit = 50
) -> Page[ReferenceOut]:  # fmt: skip
    """References in use, by name."""
    return references.page(session, cursor, limit)


@router.get("/{name:path}")
def read(name: str, session: ReadSession) -> ReferenceOut:
    """One reference: the run in use, its estimates, and what was accepted before."""
    return references.one(session, name)


@router.put("/{name:path}")
def accept(name: str, body: ReferenceIn, session: WriteSession) -> ReferenceOut:
    """Accept a run as the reference of this name; the one before stays in the history."""
    return references.accept(session, name, body)
