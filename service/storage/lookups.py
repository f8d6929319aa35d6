"""Small questions that the use cases ask: datasets by name, names of a run, how far runs are."""

from collections.abc import Collection
from typing import NamedTuple

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.storage.tables import DEFAULT_PROJECT, AcceptedReference, Dataset, RunHistory


class Reached(NamedTuple):
    """How far an open run is known to be, from the improvements written so far."""

    generation: int
    evaluations: int
    rms: float


def datasets_named(session: Session, name: str, project_id: str = DEFAULT_PROJECT) -> list[Dataset]:
    """Datasets of that very name, latest first."""
    query = select(Dataset).where(
        Dataset.project_id == project_id, Dataset.deleted_at.is_(None), Dataset.name == name
    )
    return list(session.scalars(query.order_by(Dataset.id.desc()).limit(10)))


def dataset_names(session: Session, project_id: str = DEFAULT_PROJECT) -> list[str]:
    """Names of the latest datasets, to suggest one."""
    query = select(Dataset.name).where(
        Dataset.project_id == project_id, Dataset.deleted_at.is_(None)
    )
    return list(session.scalars(query.order_by(Dataset.id.desc()).limit(200)))


def references_of(
    session: Session, run_id: str, project_id: str = DEFAULT_PROJECT
) -> list[str]:  # fmt: skip
    """Names under which a run was accepted as a reference, now or before."""
    query = select(AcceptedReference.name).where(
        AcceptedReference.project_id == project_id, AcceptedReference.run_id == run_id
    )
    return list(session.scalars(query.distinct().order_by(AcceptedReference.name)))


def reached(session: Session, run_ids: Collection[str]) -> dict[str, Reached]:
    """The furthest generation and the least RMS in the history of each run."""
    columns = (
        RunHistory.run_id,
        func.max(RunHistory.generation),
        func.max(RunHistory.evaluations),
        func.min(RunHistory.rms),
    )
    query = select(*columns).where(RunHistory.run_id.in_(run_ids)).group_by(RunHistory.run_id)
    rows = session.execute(query)
    return {run: Reached(generation, done, rms) for run, generation, done, rms in rows}
