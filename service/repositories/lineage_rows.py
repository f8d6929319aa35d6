"""Lineage: edges between datasets, jobs and runs, and walks along them.

It also has small queries of the use cases: datasets by name, names of a run, progress of runs.
"""

from collections.abc import Collection, Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Literal, NamedTuple

from sqlalchemy import Select, func, or_, select
from sqlalchemy.orm import Session, aliased

from service.storage.sessions import find_project
from service.storage.statements import insert_missing, split_chunks
from service.storage.tables import (
    AcceptedReference,
    Dataset,
    Job,
    LineageEdge,
    ModelVersion,
    Run,
    RunHistory,
)

MAX_LINKS = 1000
"""Most edges that are listed at once."""
Relation = Literal[
    "derived",
    "merged",
    "estimation",
    "validation",
    "warm-start",
    "reference",
    "model",
    "simulated",
    "computed",
]


@dataclass(frozen=True, slots=True, order=True)
class LineageLink:
    """`child` was made from `parent`."""

    child: str
    parent: str
    relation: str


class LineageRepository:
    """The lineage of one project in one session."""

    def __init__(self, session: Session, project_id: str | None = None) -> None:
        self._session, self._project_id = session, project_id or find_project(session)

    def add_links(self, child: str, parents: Iterable[str], relation: Relation) -> None:
        """Record that `child` was made from each of `parents`, and a run among them in its job."""
        edges: list[tuple[str, str, Relation]] = [(child, parent, relation) for parent in parents]
        runs = [parent for _, parent, _ in edges if parent.startswith("run_")]
        if runs:
            query = select(Run.id, Run.job_id).where(
                Run.id.in_(runs), Run.project_id == self._project_id
            )
            edges += [(run, job, "computed") for run, job in self._session.execute(query)]
        rows = (
            {"child": child, "parent": parent, "relation": kind, "project_id": self._project_id}
            for child, parent, kind in edges
        )
        insert_missing(self._session, LineageEdge, rows)

    def list_children(self, parents: Collection[str]) -> list[str]:
        """List what was made from any of these objects, each child once, sorted."""
        of_project = LineageEdge.project_id == self._project_id
        children: set[str] = set()
        for chunk in split_chunks(parents):
            query = select(LineageEdge.child).where(of_project, LineageEdge.parent.in_(chunk))
            children.update(self._session.scalars(query))
        return sorted(children)

    def list_links_to_children(
        self, parents: Collection[str], limit: int = MAX_LINKS
    ) -> list[LineageLink]:
        """List the edges from any of these objects to what was made from it, latest first."""
        query = select(LineageEdge).where(LineageEdge.parent.in_(parents))
        return self._list_links(query.order_by(LineageEdge.child.desc()), limit)

    def list_links_to_parents(
        self, children: Collection[str], limit: int = MAX_LINKS
    ) -> list[LineageLink]:
        """List the edges from any of these objects to what it was made from, latest first."""
        query = select(LineageEdge).where(LineageEdge.child.in_(children))
        return self._list_links(query.order_by(LineageEdge.parent.desc()), limit)

    def _list_links(self, query: Select[LineageEdge], limit: int) -> list[LineageLink]:
        of_project = query.where(LineageEdge.project_id == self._project_id).limit(limit)
        edges = self._session.scalars(of_project)
        return [LineageLink(row.child, row.parent, row.relation) for row in edges]

    def list_ancestors(self, identity: str) -> list[LineageLink]:
        """List every edge on the paths from the raw files to this object."""
        return self._walk_edges(identity, upward=True)

    def list_descendants(self, identity: str) -> list[LineageLink]:
        """List every edge on the paths from this object to its descendants."""
        return self._walk_edges(identity, upward=False)

    def _walk_edges(self, identity: str, *, upward: bool) -> list[LineageLink]:
        near, far = LineageEdge.child, LineageEdge.parent
        if not upward:
            near, far = far, near
        # UNION (not ALL) ends the walk even if a cycle is ever recorded.
        of_project = LineageEdge.project_id == self._project_id
        reached = select(far.label("id")).where(near == identity, of_project).cte(recursive=True)
        edge = aliased(LineageEdge)
        next_near, next_far = (edge.child, edge.parent) if upward else (edge.parent, edge.child)
        reached = reached.union(
            select(next_far).where(next_near == reached.c.id, edge.project_id == self._project_id)
        )
        query = select(LineageEdge).where(
            of_project, or_(near == identity, near.in_(select(reached.c.id)))
        )
        edges = self._session.scalars(query)
        return sorted(LineageLink(row.child, row.parent, row.relation) for row in edges)


class LineageItem(NamedTuple):
    """An object of the lineage by its name; `deleted_at` is None unless it was deleted."""

    id: str
    name: str
    deleted_at: datetime | None


def describe_items(session: Session, identities: Collection[str]) -> list[LineageItem]:
    """Read the names of these objects, and when they were deleted, the earliest first."""
    found: list[LineageItem] = []
    project = find_project(session)
    for table in (Dataset, Job, ModelVersion):
        query = select(table.id, table.name, table.deleted_at).where(
            table.id.in_(identities), table.project_id == project
        )
        found += [LineageItem(*row) for row in session.execute(query)]
    deleted_at = func.coalesce(Run.deleted_at, Job.deleted_at)
    runs = select(Run.id, Run.number, Job.name, deleted_at).join(Job, Job.id == Run.job_id)
    found += [
        LineageItem(run, f"run {number + 1} of {name}", moment)
        for run, number, name, moment in session.execute(
            runs.where(Run.id.in_(identities), Run.project_id == project)
        )
    ]
    return sorted(found, key=lambda item: item.id)


def find_tombstones(session: Session, identities: Collection[str]) -> list[LineageItem]:
    """Find those of the objects that were deleted, the earliest first."""
    return [item for item in describe_items(session, identities) if item.deleted_at is not None]


class WrittenProgress(NamedTuple):
    """Progress of an open run, from the improvements written so far."""

    generation: int
    evaluations: int
    rms: float


def find_datasets_by_name(
    session: Session, name: str, project_id: str | None = None
) -> list[Dataset]:
    """List the datasets with exactly this name, latest first."""
    query = select(Dataset).where(
        Dataset.project_id == (project_id or find_project(session)),
        Dataset.deleted_at.is_(None),
        Dataset.name == name,
    )
    return list(session.scalars(query.order_by(Dataset.id.desc()).limit(10)))


def list_dataset_names(session: Session, project_id: str | None = None) -> list[str]:
    """List the names of the latest datasets, for suggestions."""
    query = select(Dataset.name).where(
        Dataset.project_id == (project_id or find_project(session)), Dataset.deleted_at.is_(None)
    )
    return list(session.scalars(query.order_by(Dataset.id.desc()).limit(200)))


def list_reference_names(session: Session, run_id: str, project_id: str | None = None) -> list[str]:
    """List the names for which a run is or was an accepted reference."""
    query = select(AcceptedReference.name).where(
        AcceptedReference.project_id == (project_id or find_project(session)),
        AcceptedReference.run_id == run_id,
    )
    return list(session.scalars(query.distinct().order_by(AcceptedReference.name)))


def read_written_progress(session: Session, run_ids: Collection[str]) -> dict[str, WrittenProgress]:
    """Read the largest generation and the smallest RMS in the history of each run."""
    columns = (
        RunHistory.run_id,
        func.max(RunHistory.generation),
        func.max(RunHistory.evaluations),
        func.min(RunHistory.rms),
    )
    query = select(*columns).where(RunHistory.run_id.in_(run_ids)).group_by(RunHistory.run_id)
    rows = session.execute(query)
    return {run: WrittenProgress(generation, done, rms) for run, generation, done, rms in rows}
