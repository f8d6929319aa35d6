"""Stored recordings: their rows. The samples lie in the object store."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.repositories.lineage import LineageRepository, Relation
from service.storage.columns import Document, utc_now
from service.storage.errors import NotFound
from service.storage.statements import Page, new_id, page_of
from service.storage.tables import DEFAULT_PROJECT, Dataset


@dataclass(frozen=True, slots=True, kw_only=True)
class NewDataset:
    """A recording to store; its object must be in the store already.

    `kind` says how it came: ``upload``, ``simulate`` or ``derive``. `source_key` is a hash of
    what it was made from: within a project the same source gives the same dataset. `channels`
    describes each channel, `details` holds anything else (the derivation, labels, segments).
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
    details: Document = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Stored:
    """A dataset, and whether it is new or was stored before from the same source."""

    dataset: Dataset
    is_new: bool


class DatasetRepository:
    """One project's datasets in one session. Whoever opened the session commits."""

    def __init__(self, session: Session, project_id: str = DEFAULT_PROJECT) -> None:
        self._session, self._project_id = session, project_id

    def add(
        self, new: NewDataset, *, parents: Iterable[str] = (), relation: Relation = "derived"
    ) -> Stored:
        """Store a dataset and its lineage, or give the one made from the same source before."""
        known = self.by_source(new.source_key)
        if known is not None:
            return Stored(known, False)
        try:
            # Two requests with the same source at once: the later one finds the other's here.
            with self._session.begin_nested():
                dataset = self._insert(new)
        except IntegrityError:
            known = self.by_source(new.source_key)
            if known is None:
                raise
            return Stored(known, False)
        LineageRepository(self._session, self._project_id).link(dataset.id, parents, relation)
        return Stored(dataset, True)

    def by_source(self, source_key: str) -> Dataset | None:
        """The dataset that was made from this source, if there is one."""
        query = select(Dataset).where(*self._mine(), Dataset.source_key == source_key)
        return self._session.scalar(query)

    def get(self, dataset_id: str) -> Dataset:
        """A dataset of this project that was not deleted; `NotFound` otherwise."""
        dataset = self._session.get(Dataset, dataset_id, populate_existing=True)
        if (
            dataset is None
            or dataset.project_id != self._project_id
            or dataset.deleted_at is not None
        ):
            raise NotFound("dataset", dataset_id)
        return dataset

    def get_all(self, dataset_ids: Iterable[str]) -> list[Dataset]:
        """Datasets in the order asked for; `NotFound` names the first that is missing."""
        wanted = list(dataset_ids)
        query = select(Dataset).where(*self._mine(), Dataset.id.in_(wanted))
        found = {dataset.id: dataset for dataset in self._session.scalars(query)}
        for dataset_id in wanted:
            if dataset_id not in found:
                raise NotFound("dataset", dataset_id)
        return [found[dataset_id] for dataset_id in wanted]

    def page(self, *, cursor: str | None = None, limit: int = 50) -> Page[Dataset]:
        """Datasets, latest first."""
        query = select(Dataset).where(*self._mine()).order_by(Dataset.id.desc()).limit(limit + 1)
        if cursor is not None:
            query = query.where(Dataset.id < cursor)
        found = self._session.scalars(query).all()
        return page_of(found, limit, (dataset.id for dataset in found))

    def delete(self, dataset_id: str) -> None:
        """Hide a dataset. Its object becomes garbage when no other row names it."""
        self.get(dataset_id).deleted_at = utc_now()
        self._session.flush()

    def _mine(self) -> tuple[Any, ...]:
        return Dataset.project_id == self._project_id, Dataset.deleted_at.is_(None)

    def _insert(self, new: NewDataset) -> Dataset:
        dataset = row_of(new, new_id("ds"), self._project_id)
        self._session.add(dataset)
        self._session.flush()
        return dataset


def row_of(new: NewDataset, dataset_id: str, project_id: str = DEFAULT_PROJECT) -> Dataset:
    """The row of a recording, of no session: stored, or to be looked at before it is."""
    values = {name: getattr(new, name) for name in NewDataset.__slots__}
    return Dataset(id=dataset_id, project_id=project_id, n_channels=len(new.channels), **values)
