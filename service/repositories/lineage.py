"""What was made from what: edges between datasets, jobs and runs, and walks along them.

Small questions that the use cases ask: datasets by name, names of a run, how far runs are.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Literal, NamedTuple

from sqlalchemy import func, or_, select
from sqlalchemy.orm import Session, aliased

from service.storage.statements import insert_missing
from service.storage.tables import (
    DEFAULT_PROJECT,
    AcceptedReference,
    Dataset,
    LineageEdge,
    RunHistory,
)

Relation = Literal["derived", "merged", "estimation", "validation", "warm-start", "simulated"]


@dataclass(frozen=True, slots=True, order=True)
class LineageLink:
    """`child` was made from `parent`."""

    child: str
    parent: str
    relation: str


class LineageRepository:
    """One project's lineage in one session."""

    def __init__(self, session: Session, project_id: str = DEFAULT_PROJECT) -> None:
        self._session, self._project_id = session, project_id

    def add_links(self, child: str, parents: Iterable[str], relation: Relation) -> None:
        """Record that `child` was made from each of `parents`."""
        edges = (
            {"child": child, "parent": parent, "relation": relation, "project_id": self._project_id}
            for parent in parents
        )
        insert_missing(self._session, LineageEdge, edges)

    def list_ancestors(self, identity: str) -> list[LineageLink]:
        """Every edge on the ways from the raw files to this object."""
        return self._walk_edges(identity, upward=True)

    def list_descendants(self, identity: str) -> list[LineageLink]:
        """Every edge on the ways from this object to what was made from it."""
        return self._walk_edges(identity, upward=False)

    def _walk_edges(self, identity: str, *, upward: bool) -> list[LineageLink]:
        near, far = LineageEdge.child, LineageEdge.parent
        if not upward:
            near, far = far, near
        # UNION (not ALL) ends the walk even if a circle should ever be recorded.
        mine = LineageEdge.project_id == self._project_id
        reached = select(far.label("id")).where(near == identity, mine).cte(recursive=True)
        edge = aliased(LineageEdge)
        next_near, next_far = (edge.child, edge.parent) if upward else (edge.parent, edge.child)
        reached = reached.union(
            select(next_far).where(next_near == reached.c.id, edge.project_id == self._project_id)
        )
        query = select(LineageEdge).where(
            mine, or_(near == identity, near.in_(select(reached.c.id)))
        )
        found = self._session.scalars(query)
        return sorted(LineageLink(one.child, one.parent, one.relation) for one in found)


class WrittenProgress(NamedTuple):
    """How far an open run is known to be, from the improvements written so far."""

    generation: int
    evaluations: int
    rms: float


def find_datasets_by_name(
    session: Session, name: str, project_id: str = DEFAULT_PROJECT
) -> list[Dataset]:
    """Datasets of that very name, latest first."""
    query = select(Dataset).where(
        Dataset.project_id == project_id, Dataset.deleted_at.is_(None), Dataset.name == name
    )
    return list(session.scalars(query.order_by(Dataset.id.desc()).limit(10)))


def list_dataset_names(session: Session, project_id: str = DEFAULT_PROJECT) -> list[str]:
    """Names of the latest datasets, to suggest one."""
    query = select(Dataset.name).where(
        Dataset.project_id == project_id, Dataset.deleted_at.is_(None)
    )
    return list(session.scalars(query.order_by(Dataset.id.desc()).limit(200)))


def list_reference_names(
    session: Session, run_id: str, project_id: str = DEFAULT_PROJECT
) -> list[str]:
    """Names under which a run was accepted as a reference, now or before."""
    query = select(AcceptedReference.name).where(
        AcceptedReference.project_id == project_id, AcceptedReference.run_id == run_id
    )
    return list(session.scalars(query.distinct().order_by(AcceptedReference.name)))


def read_written_progress(session: Session, run_ids: Collection[str]) -> dict[str, WrittenProgress]:
    """The furthest generation and the least RMS in the history of each run."""
    columns = (
        RunHistory.run_id,
        func.max(RunHistory.generation),
        func.max(RunHistory.evaluations),
        func.min(RunHistory.rms),
    )
    query = select(*columns).where(RunHistory.run_id.in_(run_ids)).group_by(RunHistory.run_id)
    rows = session.execute(query)
    return {run: WrittenProgress(generation, done, rms) for run, generation, done, rms in rows}
