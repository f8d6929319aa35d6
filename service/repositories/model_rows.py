"""Models of users: immutable, numbered versions of a document."""

import hashlib
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, exists, func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, aliased

from service.repositories.audit_rows import record_action
from service.repositories.search_conditions import NO_FILTER, ListFilter, select_ids
from service.storage.columns import Document, to_json, utc_now
from service.storage.sessions import find_project
from service.storage.statements import RowPage, make_page, new_id
from service.storage.storage_errors import RowNotFound
from service.storage.tables import ModelVersion

_MAX_TRIES = 20


@dataclass(frozen=True, slots=True)
class AddedModel:
    """A model, and whether this version is new."""

    model: ModelVersion
    is_new: bool


class ModelRepository:
    """The models of one project in one session. The opener of the session commits."""

    def __init__(self, session: Session, project_id: str | None = None) -> None:
        self._session, self._project_id = session, project_id or find_project(session)

    def add(self, name: str, document: Document) -> AddedModel:
        """Store a document as the next version of `name`, unless it equals the latest version."""
        digest = _hash_document(document)
        for _ in range(_MAX_TRIES):
            latest = self._find_latest(name)
            if latest is not None and latest.document_hash == digest:
                return AddedModel(latest, False)
            try:
                # Two requests may want the same version number: the later one tries again.
                with self._session.begin_nested():
                    return AddedModel(self._insert_version(name, document, digest), True)
            except IntegrityError:
                continue
        raise RowNotFound("free version of model", name)

    def get(self, reference: str) -> ModelVersion:
        """Return a model by ``name`` (the latest version), ``name@version`` or identifier."""
        model = self._find_model(reference)
        if model is None:
            raise RowNotFound("model", reference)
        return model

    def list_versions(self, name: str) -> list[ModelVersion]:
        """List all versions of a model, latest first."""
        query = select(ModelVersion).where(*self._filter_project(), ModelVersion.name == name)
        return list(self._session.scalars(query.order_by(ModelVersion.version.desc())))

    def find_document(self, name: str, document: Document) -> ModelVersion | None:
        """Return the latest version of a model that has this document, if there is one."""
        query = select(ModelVersion).where(
            *self._filter_project(),
            ModelVersion.name == name,
            ModelVersion.document_hash == _hash_document(document),
        )
        return self._session.scalar(query.order_by(ModelVersion.version.desc()).limit(1))

    def list_page(
        self,
        *,
        cursor: str | None = None,
        limit: int = 50,
        chosen: ListFilter = NO_FILTER,
        only_latest: bool = False,
    ) -> RowPage[ModelVersion]:
        """List every version of the models that meet a filter, or the last ones, latest first."""
        ids = select_ids(ModelVersion, self._project_id, chosen, cursor=cursor, limit=limit)
        if only_latest:
            ids = ids.where(~self._exists_later_version())
        query = select(ModelVersion).where(ModelVersion.id.in_(list(self._session.scalars(ids))))
        rows = sorted(self._session.scalars(query), key=lambda row: row.id, reverse=True)
        return make_page(rows, limit, (model.id for model in rows))

    def delete(self, reference: str) -> None:
        """Hide one version of a model; jobs with this version keep its document."""
        model = self.get(reference)
        model.deleted_at = utc_now()
        record_action(self._session, "model.delete", model.id, self._project_id)
        self._session.flush()

    def _filter_project(self) -> tuple[Any, ...]:
        return ModelVersion.project_id == self._project_id, ModelVersion.deleted_at.is_(None)

    def _exists_later_version(self) -> ColumnElement[bool]:
        later = aliased(ModelVersion)
        return exists().where(
            later.project_id == self._project_id,
            later.deleted_at.is_(None),
            later.name == ModelVersion.name,
            later.version > ModelVersion.version,
        )

    def _find_model(self, reference: str) -> ModelVersion | None:
        name, separator, version = reference.partition("@")
        if not separator:
            by_id = select(ModelVersion).where(
                *self._filter_project(), ModelVersion.id == reference
            )
            return self._find_latest(name) or self._session.scalar(by_id)
        if not version.isascii() or not version.isdecimal() or len(version) > 9:
            return None
        query = select(ModelVersion).where(*self._filter_project(), ModelVersion.name == name)
        return self._session.scalar(query.where(ModelVersion.version == int(version)))

    def _find_latest(self, name: str) -> ModelVersion | None:
        query = select(ModelVersion).where(*self._filter_project(), ModelVersion.name == name)
        return self._session.scalar(query.order_by(ModelVersion.version.desc()).limit(1))

    def _insert_version(self, name: str, document: Document, digest: str) -> ModelVersion:
        # A deleted version keeps its number, so that name@version stays unique.
        used = select(func.max(ModelVersion.version)).where(
            ModelVersion.project_id == self._project_id, ModelVersion.name == name
        )
        model = ModelVersion(
            id=new_id("mdl"),
            project_id=self._project_id,
            name=name,
            version=(self._session.scalar(used) or 0) + 1,
            document=document,
            document_hash=digest,
        )
        self._session.add(model)
        self._session.flush()
        record_action(self._session, "model.add", model.id, self._project_id)
        return model


def _hash_document(document: Document) -> str:
    return hashlib.sha256(to_json(document).encode()).hexdigest()
