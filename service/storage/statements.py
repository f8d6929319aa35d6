"""Statements that the repositories share."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Generic, TypeVar, cast

from sqlalchemy import Table
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from service.storage.tables import Base

T = TypeVar("T")
CHUNK = 1000
"""Rows of one bulk statement: below PostgreSQL's 65,535 parameters for every table here."""

IN_PLACE = {"synchronize_session": False, "populate_existing": True}
"""For UPDATE … RETURNING: the rows come back as the database has them."""


@dataclass(frozen=True, slots=True)
class Page(Generic[T]):
    """Some of a list. `next` is the cursor of the page after it; None at the end."""

    items: tuple[T, ...]
    next: str | None


def chunks(rows: Iterable[T], size: int = CHUNK) -> Iterable[list[T]]:
    """The same rows in lists of `size`, the last one shorter."""
    left = iter(rows)
    while chunk := list(islice(left, size)):
        yield chunk


def page_of(found: Sequence[T], limit: int, cursor: Iterable[object]) -> Page[T]:
    """A page of at most `limit` of the rows found by a query that asked for one more.

    `cursor` are the cursors of the found rows, in their order.
    """
    if len(found) <= limit:
        return Page(tuple(found), None)
    return Page(tuple(found[:limit]), str(list(cursor)[limit - 1]))


def insert_missing(session: Session, table: type[Base], rows: Iterable[Mapping[str, Any]]) -> None:
    """Insert rows in bulk; those whose key is there already stay as they are."""
    for chunk in chunks(rows):
        session.execute(_insert(session, table).on_conflict_do_nothing(), chunk)


def upsert(session: Session, table: type[Base], rows: Iterable[Mapping[str, Any]]) -> None:
    """Insert rows in bulk; those whose primary key is there already are replaced."""
    keys = [column.name for column in table.__table__.primary_key]
    for chunk in chunks(rows):
        statement = _insert(session, table)
        changes = {name: statement.excluded[name] for name in chunk[0] if name not in keys}
        session.execute(statement.on_conflict_do_update(index_elements=keys, set_=changes), chunk)


def _insert(session: Session, table: type[Base]) -> "sqlite.Insert | postgresql.Insert":
    # The two dialects share ON CONFLICT, but SQLAlchemy has no common form of it.
    # The table, not the class: the ORM's way through bulk rows costs more than the database.
    name = session.get_bind().dialect.name
    target = cast(Table, table.__table__)
    return sqlite.insert(target) if name == "sqlite" else postgresql.insert(target)
