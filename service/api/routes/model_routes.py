"""Routes of models."""

from typing import Any
from urllib.parse import quote

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool

from service.api.requests.bodies import JsonRoute, check_counts, check_shape
from service.api.requests.dependencies import Cursor, Limit, PartsDep, ReadSession, WriteSession
from service.api.routes.item_queries import Cascade, FilterDep, IfMatch, delete, edit, set_etag
from service.core.bodies.user_documents import MAX_DOCUMENT_BYTES, parse_json, parse_yaml
from service.core.errors import InvalidRequest, TooLarge, UnsupportedMediaType
from service.core.root_path import to_address
from service.items.item_schemas import DeletedOut, EditIn
from service.models import catalogue, models
from service.models.model_schemas import CheckOut, ModelOut, ModelPage
from service.repositories.model_rows import ModelRepository

router = APIRouter(prefix="/v1", tags=["models"])
edit_router = APIRouter(prefix="/v1", tags=["models"], route_class=JsonRoute)

YAML_TYPES = ("application/yaml", "application/x-yaml", "text/yaml", "text/x-yaml")
DOCUMENT_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "description": "A model document: an object in JSON or YAML.",
        "content": {
            "application/json": {"schema": {"type": "object"}},
            "application/yaml": {"schema": {"type": "string"}},
        },
    }
}


@router.get("/models")
def list_models(
    session: ReadSession, chosen: FilterDep, cursor: Cursor = None, limit: Limit = 50
) -> ModelPage:
    """List models: built-in ones, then your own; all conditions must hold."""
    return models.list_models(session, cursor, limit, chosen)


@router.get("/models/{name}")
def read_model(name: str, session: ReadSession, response: Response) -> ModelOut:
    """Read a model with its document; ``name@version`` is an earlier version of your own model."""
    model = models.get_model(session, name)
    if not model.builtin:
        set_etag(response, ModelRepository(session).get(name))
    return model


@edit_router.patch("/models/{name}")
def edit_model(
    name: str,
    body: EditIn,
    session: WriteSession,
    response: Response,
    if_match: IfMatch = None,
) -> ModelOut:
    """Change note or tags of the latest version of your own model, or of ``name@version``."""
    edit(session, "model", name, body, if_match, response)
    return models.get_model(session, name)


@edit_router.delete("/models/{name}")
def delete_model(
    name: str, session: WriteSession, cascade: Cascade = False, if_match: IfMatch = None
) -> DeletedOut:
    """Delete all versions of your own model, or ``name@version``; 409 lists jobs with it."""
    return delete(session, "model", name, cascade, if_match)


@router.post("/models", status_code=201, openapi_extra=DOCUMENT_BODY)
async def add_model(request: Request, response: Response, parts: PartsDep) -> ModelOut:
    """Store your own model; a changed document becomes the next version of its name."""
    document = await _read_document(request)
    if not isinstance(document, dict):
        raise InvalidRequest.from_fault("", f"a model must be an object; found {document!r:.60}")

    def store() -> ModelOut:
        with parts.database.write_session() as session:
            return models.add_model(session, document)

    model = await run_in_threadpool(store)
    name = quote(f"{model.name}@{model.version}", safe="@")
    response.headers["Location"] = to_address(f"/v1/models/{name}")
    return model


@router.post("/models:check", openapi_extra=DOCUMENT_BODY)
async def check_model(request: Request) -> CheckOut:
    """Check a model document; each error has its pointer, and in equations its column."""
    try:
        document = await _read_document(request)
    except InvalidRequest as error:
        return CheckOut.model_validate(
            {"valid": False, "errors": [fault.to_dict() for fault in error.errors]}
        )
    return await run_in_threadpool(catalogue.check_model, document)


async def _read_document(request: Request) -> Any:
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind not in ("application/json", *YAML_TYPES):
        raise UnsupportedMediaType(f"found {kind!r}; need application/json or application/yaml")
    text = bytearray()
    async for piece in request.stream():
        text += piece
        if len(text) > MAX_DOCUMENT_BYTES:
            raise TooLarge(f"the document has more than {MAX_DOCUMENT_BYTES} bytes")
    await run_in_threadpool(check_counts, bytes(text))
    parse = parse_yaml if kind in YAML_TYPES else parse_json
    document = await run_in_threadpool(parse, bytes(text))
    await run_in_threadpool(check_shape, document)
    return document
