"""Statements that the repositories share.

Sortable, prefixed identifiers: ``job_`` and 26 characters of Crockford's base 32.

48 bits of milliseconds since 1970 and 80 random bits, as in a ULID. Within a process each
identifier is greater than the one before, also when the clock stands still or goes back.
"""

import secrets
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar, cast

from sqlalchemy import Table, bindparam
from sqlalchemy import update as update_of
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from service.storage.tables import Base

if TYPE_CHECKING:
    from sqlalchemy import Update


T = TypeVar("T")
CHUNK_ROWS = 1000
"""Rows of one bulk statement: below PostgreSQL's 65,535 parameters for every table here."""

_ID_PARAMETER = "key_of_row"

RETURNING_OPTIONS = {"synchronize_session": False, "populate_existing": True}
"""For UPDATE … RETURNING: the rows come back as the database has them."""


@dataclass(frozen=True, slots=True)
class RowPage(Generic[T]):
    """Some of a list. `next` is the cursor of the page after it; None at the end."""

    items: tuple[T, ...]
    next: str | None


def split_chunks(rows: Iterable[T], size: int = CHUNK_ROWS) -> Iterable[list[T]]:
    """The same rows in lists of `size`, the last one shorter."""
    left = iter(rows)
    while chunk := list(islice(left, size)):
        yield chunk


def make_page(found: Sequence[T], limit: int, cursor: Iterable[object]) -> RowPage[T]:
    """A page of at most `limit` of the rows found by a query that asked for one more.

    `cursor` are the cursors of the found rows, in their order.
    """
    if len(found) <= limit:
        return RowPage(tuple(found), None)
    return RowPage(tuple(found[:limit]), str(list(cursor)[limit - 1]))


def insert_missing(session: Session, table: type[Base], rows: Iterable[Mapping[str, Any]]) -> None:
    """Insert rows in bulk; those whose key is there already stay as they are."""
    for chunk in split_chunks(rows):
        _execute_bulk(session, table, _build_insert(session, table).on_conflict_do_nothing(), chunk)


def upsert(session: Session, table: type[Base], rows: Iterable[Mapping[str, Any]]) -> None:
    """Insert rows in bulk; those whose primary key is there already are replaced."""
    keys = [column.name for column in table.__table__.primary_key]
    for chunk in split_chunks(rows):
        statement = _build_insert(session, table)
        changes = {name: statement.excluded[name] for name in chunk[0] if name not in keys}
        statement = statement.on_conflict_do_update(index_elements=keys, set_=changes)
        _execute_bulk(session, table, statement, chunk)


def update_by_id(session: Session, table: type[Base], rows: Iterable[Mapping[str, Any]]) -> None:
    """Change rows in bulk, each found by its `id`; all rows name the same columns."""
    target = cast(Table, table.__table__)
    for chunk in split_chunks(rows):
        statement = update_of(target).where(target.c.id == bindparam(_ID_PARAMETER))
        _execute_bulk(session, table, statement, [_rename_id(row) for row in chunk])


def _rename_id(row: Mapping[str, Any]) -> dict[str, Any]:
    return {_ID_PARAMETER if name == "id" else name: value for name, value in row.items()}


def _execute_bulk(
    session: Session,
    table: type[Base],
    statement: "sqlite.Insert | postgresql.Insert | Update",
    rows: Sequence[Mapping[str, Any]],
) -> None:
    """Carry a statement out for many rows of the same columns.

    SQLAlchemy makes a dictionary of each row, then the driver's; a thousand rows of a history are
    a tenth of a run's time. Here the columns' own conversions are applied column by column.
    """
    session.flush()
    connection = session.connection()
    dialect, columns = connection.dialect, cast(Table, table.__table__).c
    names = list(rows[0])
    compiled = statement.compile(
        dialect=dialect, column_keys=[name for name in names if name != _ID_PARAMETER]
    )
    if compiled.insert_prefetch or compiled.update_prefetch:  # defaults that are made row by row
        session.execute(statement, rows)
        return
    values = []
    for name in names:
        kind = columns["id" if name == _ID_PARAMETER else name].type.dialect_impl(dialect)
        convert = kind.bind_processor(dialect)
        column = [row[name] for row in rows]
        values.append(column if convert is None else [convert(one) for one in column])
    if compiled.positional:
        order = [names.index(name) for name in compiled.positiontup or ()]
        given: Any = list(zip(*(values[i] for i in order), strict=True))
    else:
        given = [dict(zip(names, row, strict=True)) for row in zip(*values, strict=True)]
    connection.exec_driver_sql(str(compiled), given)


def _build_insert(session: Session, table: type[Base]) -> "sqlite.Insert | postgresql.Insert":
    # The two dialects share ON CONFLICT, but SQLAlchemy has no common form of it.
    # The table, not the class: the ORM's way through bulk rows costs more than the database.
    name = session.get_bind().dialect.name
    target = cast(Table, table.__table__)
    return sqlite.insert(target) if name == "sqlite" else postgresql.insert(target)


IdPrefix = Literal["proj", "key", "ds", "mdl", "job", "run"]

_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"
_RANDOM_BITS = 80
_LENGTH = 26


class _IdSequence:
    """Strictly increasing 128-bit numbers, led by the time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last = 0

    def take_numbers(self, n: int) -> range:
        """The next `n` numbers, consecutive from the second on."""
        with self._lock:
            fresh = time.time_ns() // 1_000_000 << _RANDOM_BITS | secrets.randbits(_RANDOM_BITS)
            first = max(fresh, self._last + 1)
            self._last = first + n - 1
            return range(first, first + n)


_id_sequence = _IdSequence()


def new_id(prefix: IdPrefix) -> str:
    """A new identifier, greater than every one this process made before."""
    return new_ids(prefix, 1)[0]


def new_ids(prefix: IdPrefix, n: int) -> list[str]:
    """`n` new identifiers, ascending."""
    return [f"{prefix}_{_encode_base32(number)}" for number in _id_sequence.take_numbers(n)]


def _encode_base32(number: int) -> str:
    shifts = range(5 * (_LENGTH - 1), -1, -5)
    return "".join(_ALPHABET[number >> shift & 31] for shift in shifts)
