"""Routes of references."""

from fastapi import APIRouter, Response

from service.api.requests.bodies import JsonRoute
from service.api.requests.dependencies import Cursor, Limit, ReadSession, WriteSession
from service.api.routes.item_queries import Cascade, FilterDep, IfMatch, delete, edit, set_etag
from service.items.item_schemas import DeletedOut, EditIn
from service.jobs import references
from service.jobs.job_schemas import ReferenceIn, ReferenceOut, ReferencePage
from service.repositories.reference_rows import ReferenceRepository

reference_router = APIRouter(prefix="/v1/references", tags=["references"], route_class=JsonRoute)


@reference_router.get("")
def list_references(
    session: ReadSession, chosen: FilterDep, cursor: Cursor = None, limit: Limit = 50
) -> ReferencePage:
    """List the current references by name; all conditions must hold."""
    return references.list_references(session, cursor, limit, chosen)


@reference_router.get("/{name:path}")
def read_reference(name: str, session: ReadSession, response: Response) -> ReferenceOut:
    """Read a reference: the accepted run, its estimates, and previously accepted runs."""
    answer = references.get_reference(session, name)
    set_etag(response, ReferenceRepository(session).get_latest(name))
    return answer


@reference_router.patch("/{name:path}")
def edit_reference(
    name: str, body: EditIn, session: WriteSession, response: Response, if_match: IfMatch = None
) -> ReferenceOut:
    """Change name, note or tags of a reference; jobs keep the runs that they named."""
    edit(session, "reference", name, body, if_match, response)
    return references.get_reference(session, body.name or name)


@reference_router.delete("/{name:path}")
def delete_reference(
    name: str, session: WriteSession, cascade: Cascade = False, if_match: IfMatch = None
) -> DeletedOut:
    """Delete a reference with its history; the accepted runs stay."""
    return delete(session, "reference", name, cascade, if_match)


@reference_router.put("/{name:path}")
def accept_reference(name: str, body: ReferenceIn, session: WriteSession) -> ReferenceOut:
    """Accept a run as the reference of this name; the previous run stays in the history."""
    return references.accept_reference(session, name, body)
