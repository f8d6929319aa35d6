"""The rows of stored recordings. The samples are in the object store."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.repositories.audit_rows import record_action
from service.repositories.lineage_rows import LineageRepository, Relation
from service.repositories.project_rows import check_stored_bytes
from service.repositories.search_conditions import (
    NO_FILTER,
    ListFilter,
    add_terms,
    list_label_terms,
    select_ids,
)
from service.storage.columns import Document, utc_now
from service.storage.sessions import find_project
from service.storage.statements import RowPage, make_page, new_id
from service.storage.storage_errors import RowNotFound
from service.storage.tables import DEFAULT_PROJECT, Dataset


@dataclass(frozen=True, slots=True, kw_only=True)
class NewDataset:
    """A recording to store; its object must be in the store already.

    `kind` is its origin: ``upload``, ``simulate`` or ``derive``. `source_key` is a hash of the
    source: within a project the same source gives the same dataset. `channels` describes each
    channel, `details` holds the rest (derivation, labels, segments).
    """

    name: str
    kind: str
    sha256: str
    source_key: str
    size_bytes: int
    n_samples: int
    duration: float
    sample_time: float | None
    channels: list[Any]
    details: Document


@dataclass(frozen=True, slots=True)
class StoredDataset:
    """A dataset, and whether it is new or existed already from the same source."""

    dataset: Dataset
    is_new: bool


class DatasetRepository:
    """The datasets of one project in one session. The opener of the session commits."""

    def __init__(self, session: Session, project_id: str | None = None) -> None:
        self._session, self._project_id = session, project_id or find_project(session)

    def add(
        self, new: NewDataset, *, parents: Iterable[str] = (), relation: Relation = "derived"
    ) -> StoredDataset:
        """Store a dataset and its lineage, or return the existing one of the same source.

        Raises
        ------
        BudgetExceeded
            If the project would store more bytes than it may.
        """
        existing = self.find_by_source(new.source_key)
        if existing is not None:
            return StoredDataset(existing, False)
        try:
            # Of two requests with the same source at once, the later one fails here.
            with self._session.begin_nested():
                dataset = self._insert_row(new)
        except IntegrityError:
            existing = self.find_by_source(new.source_key)
            if existing is None:
                raise
            return StoredDataset(existing, False)
        check_stored_bytes(self._session, self._project_id)
        LineageRepository(self._session, self._project_id).add_links(dataset.id, parents, relation)
        labels = [
            term
            for segment in new.details["segments"]
            for term in list_label_terms(segment["labels"])
        ]
        add_terms(self._session, "dataset", dataset.id, labels, self._project_id)
        record_action(self._session, "dataset.add", dataset.id, self._project_id)
        return StoredDataset(dataset, True)

    def find_by_source(self, source_key: str) -> Dataset | None:
        """Return the dataset of this source, if there is one."""
        query = select(Dataset).where(*self._filter_project(), Dataset.source_key == source_key)
        return self._session.scalar(query)

    def has_object(self, sha256: str) -> bool:
        """Return whether an object is that of a dataset."""
        query = select(Dataset.id).where(*self._filter_project(), Dataset.sha256 == sha256)
        return self._session.scalar(query.limit(1)) is not None

    def get(self, dataset_id: str) -> Dataset:
        """Return an undeleted dataset of this project; else raise `RowNotFound`."""
        dataset = self._session.get(Dataset, dataset_id, populate_existing=True)
        if (
            dataset is None
            or dataset.project_id != self._project_id
            or dataset.deleted_at is not None
        ):
            raise RowNotFound("dataset", dataset_id)
        return dataset

    def get_all(self, dataset_ids: Iterable[str]) -> list[Dataset]:
        """Return datasets in the requested order; `RowNotFound` names the first missing one."""
        wanted = list(dataset_ids)
        query = select(Dataset).where(*self._filter_project(), Dataset.id.in_(wanted))
        rows = {dataset.id: dataset for dataset in self._session.scalars(query)}
        for dataset_id in wanted:
            if dataset_id not in rows:
                raise RowNotFound("dataset", dataset_id)
        return [rows[dataset_id] for dataset_id in wanted]

    def list_page(
        self, *, cursor: str | None = None, limit: int = 50, chosen: ListFilter = NO_FILTER
    ) -> RowPage[Dataset]:
        """List the datasets that meet a filter, latest first."""
        ids = select_ids(Dataset, self._project_id, chosen, cursor=cursor, limit=limit)
        query = select(Dataset).where(Dataset.id.in_(list(self._session.scalars(ids))))
        rows = sorted(self._session.scalars(query), key=lambda row: row.id, reverse=True)
        return make_page(rows, limit, (dataset.id for dataset in rows))

    def lock_used(self, dataset_ids: Iterable[str]) -> None:
        """Keep datasets from being deleted until the session ends; `RowNotFound` if one is gone."""
        wanted = sorted(set(dataset_ids))
        query = select(Dataset.id).where(*self._filter_project(), Dataset.id.in_(wanted))
        lock = query.order_by(Dataset.id).with_for_update(read=True, key_share=True)
        existing = set(self._session.scalars(lock))
        for dataset_id in wanted:
            if dataset_id not in existing:
                raise RowNotFound("dataset", dataset_id)

    def delete(self, dataset_id: str) -> None:
        """Hide a dataset. Its object becomes garbage when no other row refers to it."""
        self.get(dataset_id).deleted_at = utc_now()
        record_action(self._session, "dataset.delete", dataset_id, self._project_id)
        self._session.flush()

    def _filter_project(self) -> tuple[Any, ...]:
        return Dataset.project_id == self._project_id, Dataset.deleted_at.is_(None)

    def _insert_row(self, new: NewDataset) -> Dataset:
        dataset = build_dataset_row(new, new_id("ds"), self._project_id)
        self._session.add(dataset)
        self._session.flush()
        return dataset


def build_dataset_row(
    new: NewDataset, dataset_id: str, project_id: str = DEFAULT_PROJECT
) -> Dataset:
    """Build the row of a recording without a session: to store it, or to preview it."""
    values = {name: getattr(new, name) for name in NewDataset.__slots__}
    return Dataset(id=dataset_id, project_id=project_id, n_channels=len(new.channels), **values)
