"""Use cases of models: the catalogue, and user models with versions.

Estimates of different runs are comparable only if their models have the same equations.
"""

import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from sqlalchemy.orm import Session

from service.core.errors import InvalidRequest, NotFound
from service.models.catalogue import list_catalogue, to_builtin_out, to_model_out
from service.models.model_schemas import ModelOut, ModelPage
from service.repositories.model_rows import ModelRepository
from service.repositories.search_conditions import NO_FILTER, ListFilter
from service.storage import storage_errors
from service.storage.tables import ModelVersion as StoredModel
from sysid.core.errors import InvalidModel, UnknownModel, suggest_name
from sysid.models.catalogue import load
from sysid.models.model import Model, replace_substeps
from sysid.models.parse import keep_terms, parse_model
from sysid.models.starts import replace_starts


def list_models(
    session: Session,
    cursor: str | None,
    limit: int,
    chosen: ListFilter = NO_FILTER,
    *,
    only_latest: bool = False,
) -> ModelPage:
    """List the built-in models (first page), then all versions of user models, latest first.

    Or only the last version of each.

    Built-in models have names only: a filter of tags or times excludes them.
    """
    stored = ModelRepository(session).list_page(
        cursor=cursor, limit=limit, chosen=chosen, only_latest=only_latest
    )
    part = (chosen.name or "").lower()
    is_first = not (cursor or chosen.terms or chosen.since or chosen.until)
    built_in = [model for model in list_catalogue() if part in model.name] if is_first else []
    return ModelPage(items=built_in + [to_own_out(row) for row in stored.items], next=stored.next)


def get_model(session: Session, reference: str) -> ModelOut:
    """Return a model by ``name`` or ``name@version``.

    Raises
    ------
    NotFound
        With the most similar name.
    """
    if reference in load.catalogue():
        return to_builtin_out(reference, with_document=True)
    return to_own_out(_get_own_model(session, reference), with_document=True)


def add_model(session: Session, document: Mapping[str, Any]) -> ModelOut:
    """Store a user model; the same document again returns the same version.

    Raises
    ------
    InvalidRequest
        If it has faults, or its name is that of a built-in model.
    """
    model = parse_model(document)
    if model.name in load.catalogue():
        raise InvalidRequest.from_fault(
            "/name", f"{model.name!r} is the name of a built-in model; choose another"
        )
    stored = ModelRepository(session).add(model.name, dict(model.document))
    return to_own_out(stored.model, with_document=True)


def resolve_model(session: Session, reference: Any) -> tuple[Model, Any]:
    """Return the model that a job names, and what to store for it.

    A built-in model stays a name. A user model is stored as its document, so that a later version
    does not change the submitted job.

    Raises
    ------
    InvalidModel, UnknownModel
        If a document has faults, or no model has that name.
    """
    if isinstance(reference, Mapping):
        return parse_model(reference), dict(reference)
    if reference in load.catalogue():
        return load.load_model(reference), reference
    try:
        row = _get_own_model(session, reference)
    except NotFound:
        raise UnknownModel(reference, _list_names(session)) from None
    return parse_model(row.document), row.document


def load_stored_model(reference: Any) -> Model:
    """Load the model of a stored body: the name of a built-in one, or a document.

    Raises
    ------
    InvalidModel, UnknownModel
        If the document has faults, or no built-in model has that name.
    """
    if isinstance(reference, str):
        return load.load_model(reference)
    return _parse_stored(json.dumps(reference))


@lru_cache(maxsize=256)
def _parse_stored(document: str) -> Model:
    return parse_model(json.loads(document))


def apply_result(model: Model, result: Mapping[str, Any] | None) -> Model:
    """Return the model of a run's result document: with its terms, its substeps and its starts."""
    found = result or {}
    if model.rule is not None and found.get("selection"):
        model = keep_terms(model, [entry["term"] for entry in found["selection"]])
    substeps = found.get("substeps", model.solver.substeps)
    if substeps != model.solver.substeps:
        model = replace_substeps(model, substeps)
    return replace_starts(model, found.get("initial"))


def _get_own_model(session: Session, reference: str) -> StoredModel:
    try:
        return ModelRepository(session).get(reference)
    except storage_errors.RowNotFound:
        raise NotFound("model", reference, suggest_name(reference, _list_names(session))) from None


def _list_names(session: Session) -> set[str]:
    stored = ModelRepository(session).list_page(limit=1000).items
    return {*load.catalogue(), *(row.name for row in stored)}


def to_own_out(row: StoredModel, *, with_document: bool = False) -> ModelOut:
    """Convert a stored model to an answer.

    One that an earlier version accepted and this one refuses has the reason as its title.
    """
    document = row.document if with_document else None
    try:
        answer = to_model_out(parse_model(row.document), row.version, document)
    except InvalidModel as error:
        answer = ModelOut(
            name=row.name,
            version=row.version,
            builtin=False,
            title=f"refused by this version: {error}",
            form=str(row.document.get("form", "")),
            inputs={},
            outputs={},
            parameters={},
            document=document,
        )
    return answer.model_copy(update={"note": row.note, "tags": row.tags or []})


_IRRELEVANT_KEYS = ("name", "title", "description", "source", "parameters", "initial", "solver")
"""Keys of a model document that do not define the meaning of its parameters."""


def have_same_equations(model: Model, other: Model) -> bool:
    """Return whether two models have the same equations, parameters and units.

    Names, texts, bounds, initial states and the solver may differ.
    """
    return bool(_extract_equations(model) == _extract_equations(other))


def _extract_equations(model: Model) -> Any:
    document = {key: value for key, value in model.document.items() if key not in _IRRELEVANT_KEYS}
    return document, [(parameter.name, parameter.unit) for parameter in model.parameters]
