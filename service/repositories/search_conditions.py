"""Search of lists: by name, term and time. Terms are rows, so that an index finds them."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Literal, TypeAlias

from sqlalchemy import ColumnElement, Select, delete, exists, select
from sqlalchemy.orm import Session, aliased

from service.storage.sessions import find_project
from service.storage.statements import IdPrefix, check_id_cursor, insert_missing, make_id_bound
from service.storage.tables import Dataset, Job, ModelVersion, SearchTerm

ItemKind = Literal["job", "run", "dataset", "model", "reference"]
TermKind = Literal["tag", "label", "model", "dataset"]
SearchedTable: TypeAlias = type[Job] | type[Dataset] | type[ModelVersion]
Term: TypeAlias = tuple[TermKind, str]

CLOCK_SLACK = timedelta(hours=1)
"""An identifier may be older or younger than its row by this time: clocks are set."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ListFilter:
    """Conditions that the items of a list meet, all of them.

    Attributes
    ----------
    name : str or None
        Part of the name; upper and lower case of Latin letters are equal.
    terms : tuple of (kind, value)
        Tags, labels, models and datasets of the item.
    since, until : datetime or None
        The item was stored at `since` or later, and before `until`.
    """

    name: str | None = None
    terms: tuple[Term, ...] = ()
    since: datetime | None = None
    until: datetime | None = None

    def __bool__(self) -> bool:
        """Return whether there is any condition."""
        return bool(self.name or self.terms or self.since or self.until)


NO_FILTER = ListFilter()
_TABLES: Mapping[SearchedTable, tuple[ItemKind, IdPrefix]] = {
    Job: ("job", "job"),
    Dataset: ("dataset", "ds"),
    ModelVersion: ("model", "mdl"),
}


def select_ids(
    table: SearchedTable, project_id: str, chosen: ListFilter, *, cursor: str | None, limit: int
) -> Select[str]:
    """Select the identifiers of undeleted items that meet a filter, the latest first.

    With a term, its range of the primary key is walked in this order; other terms are looked up.
    Without one, an index that has the names is walked.
    """
    _, prefix = _TABLES[table]
    query = select_matches(table, project_id, chosen)
    (order,) = query.selected_columns
    if cursor is not None:
        query = query.where(order < check_id_cursor(cursor, prefix))
    return query.order_by(order.desc()).limit(limit + 1)


def select_matches(table: SearchedTable, project_id: str, chosen: ListFilter) -> Select[str]:
    """Select the identifiers of undeleted items that meet a filter, in no order."""
    item, prefix = _TABLES[table]
    conditions = [table.project_id == project_id, table.deleted_at.is_(None)]
    if not chosen.terms:
        query, order = select(table.id), table.id
    else:
        first, *others = chosen.terms
        query = select(SearchTerm.item_id).join(table, table.id == SearchTerm.item_id)
        query, order = (
            query.where(*_match_term(SearchTerm, project_id, item, first)),
            SearchTerm.item_id,
        )
        conditions += [_has_term(table.id, project_id, item, term) for term in others]
    if chosen.name:
        conditions.append(table.name.icontains(chosen.name, autoescape=True))
    if chosen.since is not None:
        bound = make_id_bound(prefix, chosen.since - CLOCK_SLACK)
        conditions += [order >= bound, table.created_at >= chosen.since]
    if chosen.until is not None:
        bound = make_id_bound(prefix, chosen.until + CLOCK_SLACK)
        conditions += [order < bound, table.created_at < chosen.until]
    return query.where(*conditions)


def select_items_with(kind: ItemKind, project_id: str, term: Term) -> Select[str]:
    """Select the items of a kind that have a term."""
    return select(SearchTerm.item_id).where(*_match_term(SearchTerm, project_id, kind, term))


def add_terms(
    session: Session,
    kind: ItemKind,
    item_id: str,
    terms: Iterable[Term],
    project_id: str | None = None,
) -> None:
    """Store terms of an item."""
    owner = project_id or find_project(session)
    rows = (
        {"project_id": owner, "kind": f"{kind}:{what}", "value": value, "item_id": item_id}
        for what, value in dict.fromkeys(terms)
    )
    insert_missing(session, SearchTerm, rows)


def replace_tags(
    session: Session,
    kind: ItemKind,
    item_id: str,
    tags: Iterable[str],
    project_id: str | None = None,
) -> None:
    """Store the tags of an item in the place of earlier ones."""
    session.execute(
        delete(SearchTerm).where(
            SearchTerm.item_id == item_id,
            SearchTerm.project_id == (project_id or find_project(session)),
            SearchTerm.kind == f"{kind}:tag",
        )
    )
    add_terms(session, kind, item_id, (("tag", tag) for tag in tags), project_id)


def delete_terms(session: Session, item_id: str, project_id: str | None = None) -> None:
    """Delete all terms of an item."""
    session.execute(
        delete(SearchTerm).where(
            SearchTerm.item_id == item_id,
            SearchTerm.project_id == (project_id or find_project(session)),
        )
    )


def list_label_terms(labels: Mapping[str, Any]) -> Iterator[Term]:
    """List the terms of labels, such as ``length_m=5``; a whole number has no decimals."""
    for name, value in labels.items():
        is_whole = isinstance(value, float) and value.is_integer()
        yield "label", f"{name}={int(value) if is_whole else value}"


def _match_term(
    table: Any, project_id: str, kind: ItemKind, term: Term
) -> tuple[ColumnElement[bool], ...]:
    what, value = term
    return table.project_id == project_id, table.kind == f"{kind}:{what}", table.value == value


def _has_term(item_id: Any, project_id: str, kind: ItemKind, term: Term) -> ColumnElement[bool]:
    other = aliased(SearchTerm)
    match = _match_term(other, project_id, kind, term)
    return exists(select(1).where(*match, other.item_id == item_id))
