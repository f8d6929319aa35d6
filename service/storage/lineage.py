"""What was made from what: edges between datasets, jobs and runs, and walks along them."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import or_, select
from sqlalchemy.orm import Session, aliased

from service.storage.statements import insert_missing
from service.storage.tables import DEFAULT_PROJECT, LineageEdge

Relation = Literal["derived", "merged", "estimation", "validation", "warm-start", "simulated"]


@dataclass(frozen=True, slots=True, order=True)
class Edge:
    """`child` was made from `parent`."""

    child: str
    parent: str
    relation: str


class LineageRepository:
    """One project's lineage in one session."""

    def __init__(self, session: Session, project_id: str = DEFAULT_PROJECT) -> None:
        self._session, self._project_id = session, project_id

    def link(self, child: str, parents: Iterable[str], relation: Relation) -> None:
        """Record that `child` was made from each of `parents`."""
        edges = (
            {"child": child, "parent": parent, "relation": relation, "project_id": self._project_id}
            for parent in parents
        )
        insert_missing(self._session, LineageEdge, edges)

    def ancestors(self, identity: str) -> list[Edge]:
        """Every edge on the ways from the raw files to this object."""
        return self._walk(identity, upward=True)

    def descendants(self, identity: str) -> list[Edge]:
        """Every edge on the ways from this object to what was made from it."""
        return self._walk(identity, upward=False)

    def _walk(self, identity: str, *, upward: bool) -> list[Edge]:
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
        return sorted(Edge(one.child, one.parent, one.relation) for one in found)
