"""Routes of references."""

from fastapi import APIRouter

from service import references
from service.api.deps import ReadSession, WriteSession
from service.schemas_references import ReferenceIn, ReferenceOut, ReferencesOut

router = APIRouter(prefix="/v1/references", tags=["references"])


@router.get("")
def page(session: ReadSession) -> ReferencesOut:
    """All references in use, by name."""
    return references.page(session)


@router.get("/{name}")
def read(name: str, session: ReadSession) -> ReferenceOut:
    """One reference: the run in use, its estimates, and what was accepted before."""
    return references.one(session, name)


@router.put("/{name}")
def accept(name: str, body: ReferenceIn, session: WriteSession) -> ReferenceOut:
    """Accept a run as the reference of this name; the one before stays in the history."""
    return references.accept(session, name, body)
