"""Users' own models: immutable, numbered versions of a document."""

import hashlib
from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.storage.columns import Document, to_json, utc_now
from service.storage.errors import NotFound
from service.storage.statements import Page, new_id, page_of
from service.storage.tables import DEFAULT_PROJECT, Model

_RIVALS = 20


@dataclass(frozen=True, slots=True)
class StoredModel:
    """A model, and whether this version is new."""

    model: Model
    is_new: bool


class ModelRepository:
    """One project's models in one session. Whoever opened the session commits."""

    def __init__(self, session: Session, project_id: str = DEFAULT_PROJECT) -> None:
        self._session, self._project_id = session, project_id

    def add(self, name: str, document: Document) -> StoredModel:
        """Store a document as the next version of `name`; the latest again if it is the same."""
        digest = hashlib.sha256(to_json(document).encode()).hexdigest()
        for _ in range(_RIVALS):
            latest = self._latest(name)
            if latest is not None and latest.document_hash == digest:
                return StoredModel(latest, False)
            try:
                # Two requests may want the same version number: the later one tries again.
                with self._session.begin_nested():
                    return StoredModel(self._insert(name, document, digest), True)
            except IntegrityError:
                continue
        raise NotFound("free version of model", name)

    def get(self, reference: str) -> Model:
        """A model by ``name`` (the latest version), ``name@version`` or identifier."""
        model = self._find(reference)
        if model is None:
            raise NotFound("model", reference)
        return model

    def page(self, *, cursor: str | None = None, limit: int = 50) -> Page[Model]:
        """Every version of every model, latest first."""
        query = select(Model).where(*self._mine()).order_by(Model.id.desc()).limit(limit + 1)
        if cursor is not None:
            query = query.where(Model.id < cursor)
        found = self._session.scalars(query).all()
        return page_of(found, limit, (model.id for model in found))

    def delete(self, reference: str) -> None:
        """Hide one version of a model; jobs that used it keep its document."""
        self.get(reference).deleted_at = utc_now()
        self._session.flush()

    def _mine(self) -> tuple[Any, ...]:
        return Model.project_id == self._project_id, Model.deleted_at.is_(None)

    def _find(self, reference: str) -> Model | None:
        name, at, version = reference.partition("@")
        if not at:
            by_id = select(Model).where(*self._mine(), Model.id == reference)
            return self._latest(name) or self._session.scalar(by_id)
        if not version.isascii() or not version.isdecimal() or len(version) > 9:
            return None
        query = select(Model).where(*self._mine(), Model.name == name)
        return self._session.scalar(query.where(Model.version == int(version)))

    def _latest(self, name: str) -> Model | None:
        query = select(Model).where(*self._mine(), Model.name == name)
        return self._session.scalar(query.order_by(Model.version.desc()).limit(1))

    def _insert(self, name: str, document: Document, digest: str) -> Model:
        # A deleted version keeps its number, so that name@version never means two documents.
        used = select(func.max(Model.version)).where(
            Model.project_id == self._project_id, Model.name == name
        )
        model = Model(
            id=new_id("mdl"), project_id=self._project_id, name=name,
            version=(self._session.scalar(used) or 0) + 1, document=document,
            document_hash=digest,
        )  # fmt: skip
        self._session.add(model)
        self._session.flush()
        return model
