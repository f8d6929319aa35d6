"""Statements and identifiers that the repositories share.

An identifier is a prefix and 26 characters of Crockford's base 32, such as ``job_…``. It encodes 48
bits of milliseconds since 1970 and 80 random bits, as in a ULID. Within a process each identifier
is greater than the previous one, even if the clock stands still or goes back.
"""

import secrets
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import islice
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar, cast

from sqlalchemy import Table, bindparam
from sqlalchemy import update as update_of
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from service.storage.storage_errors import InvalidCursor
from service.storage.tables import Base

if TYPE_CHECKING:
    from sqlalchemy import Update


T = TypeVar("T")
CHUNK_ROWS = 1000
"""Rows of one bulk statement; no table exceeds PostgreSQL's 65,535 parameters with it."""

_ID_PARAMETER = "key_of_row"

RETURNING_OPTIONS = {"synchronize_session": False, "populate_existing": True}
"""Options of UPDATE … RETURNING: the rows are loaded as the database stores them."""


@dataclass(frozen=True, slots=True)
class RowPage(Generic[T]):
    """A part of a list; `next` is the cursor of the next page, None at the end."""

    items: tuple[T, ...]
    next: str | None


def split_chunks(rows: Iterable[T], size: int = CHUNK_ROWS) -> Iterable[list[T]]:
    """Split rows into lists of `size`; the last one may be shorter."""
    left = iter(rows)
    while chunk := list(islice(left, size)):
        yield chunk


def make_page(rows: Sequence[T], limit: int, cursor: Iterable[object]) -> RowPage[T]:
    """Make a page of at most `limit` rows from a query that asked for one more.

    `cursor` are the cursors of these rows, in their order.
    """
    if len(rows) <= limit:
        return RowPage(tuple(rows), None)
    return RowPage(tuple(rows[:limit]), str(list(cursor)[limit - 1]))


def insert_missing(session: Session, table: type[Base], rows: Iterable[Mapping[str, Any]]) -> None:
    """Insert rows in bulk; rows whose key exists already stay unchanged."""
    for chunk in split_chunks(rows):
        _execute_bulk(session, table, _build_insert(session, table).on_conflict_do_nothing(), chunk)


def upsert(session: Session, table: type[Base], rows: Iterable[Mapping[str, Any]]) -> None:
    """Insert rows in bulk; rows whose primary key exists already are replaced."""
    keys = [column.name for column in table.__table__.primary_key]
    for chunk in split_chunks(rows):
        statement = _build_insert(session, table)
        changes = {name: statement.excluded[name] for name in chunk[0] if name not in keys}
        statement = statement.on_conflict_do_update(index_elements=keys, set_=changes)
        _execute_bulk(session, table, statement, chunk)


def update_by_id(session: Session, table: type[Base], rows: Iterable[Mapping[str, Any]]) -> None:
    """Update rows in bulk by their `id`; all rows name the same columns."""
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
    """Execute a statement for many rows with the same columns.

    SQLAlchemy makes a dictionary of each row, then one for the driver. For a thousand rows of a
    history this takes a tenth of the time of a run. Here the conversions of the columns are applied
    column by column.
    """
    session.flush()
    connection = session.connection()
    dialect, columns = connection.dialect, cast(Table, table.__table__).c
    names = list(rows[0])
    compiled = statement.compile(
        dialect=dialect, column_keys=[name for name in names if name != _ID_PARAMETER]
    )
    if (
        compiled.insert_prefetch or compiled.update_prefetch
    ):  # defaults that are computed row by row
        session.execute(statement, rows)
        return
    values = []
    for name in names:
        kind = columns["id" if name == _ID_PARAMETER else name].type.dialect_impl(dialect)
        convert = kind.bind_processor(dialect)
        column = [row[name] for row in rows]
        if convert is None:
            values.append(column)
        elif len(set(map(id, column))) == 1:  # one value for all rows
            values.append([convert(column[0])] * len(column))
        else:
            values.append([convert(value) for value in column])
    if compiled.positional:
        order = [names.index(name) for name in compiled.positiontup or ()]
        parameters: Any = list(zip(*(values[i] for i in order), strict=True))
    else:
        parameters = [dict(zip(names, row, strict=True)) for row in zip(*values, strict=True)]
    connection.exec_driver_sql(str(compiled), parameters)


def _build_insert(session: Session, table: type[Base]) -> "sqlite.Insert | postgresql.Insert":
    # The two dialects share ON CONFLICT, but SQLAlchemy has no common form of it.
    # The table, not the class: bulk rows through the ORM cost more than the database.
    name = session.get_bind().dialect.name
    target = cast(Table, table.__table__)
    return sqlite.insert(target) if name == "sqlite" else postgresql.insert(target)


IdPrefix = Literal["proj", "key", "ds", "mdl", "job", "run"]

_ALPHABET = "0123456789abcdefghjkmnpqrstvwxyz"
_PAIRS = [first + second for first in _ALPHABET for second in _ALPHABET]
_TAIL_BITS = 20
"""Bits of the last four characters, in which consecutive identifiers differ."""
_RANDOM_BITS = 80
_LENGTH = 26


class _IdSequence:
    """Strictly increasing 128-bit numbers that begin with the time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._last = 0

    def take_numbers(self, n: int) -> range:
        """Take the next `n` numbers; they are consecutive."""
        with self._lock:
            fresh = time.time_ns() // 1_000_000 << _RANDOM_BITS | secrets.randbits(_RANDOM_BITS)
            first = max(fresh, self._last + 1)
            self._last = first + n - 1
            return range(first, first + n)


_id_sequence = _IdSequence()


def new_id(prefix: IdPrefix) -> str:
    """Make a new identifier, greater than every previous one of this process."""
    return new_ids(prefix, 1)[0]


def new_ids(prefix: IdPrefix, n: int) -> list[str]:
    """Make `n` new identifiers, ascending."""
    numbers = _id_sequence.take_numbers(n)
    heads = {
        head: f"{prefix}_{_encode_base32(head << _TAIL_BITS)[:-4]}"
        for head in range(numbers[0] >> _TAIL_BITS, (numbers[-1] >> _TAIL_BITS) + 1)
    }
    return [
        f"{heads[number >> _TAIL_BITS]}{_PAIRS[number >> 10 & 1023]}{_PAIRS[number & 1023]}"
        for number in numbers
    ]


def make_id_bound(prefix: IdPrefix, moment: datetime) -> str:
    """Return the least identifier of an item that is made at this moment."""
    return f"{prefix}_{_encode_base32(max(0, int(moment.timestamp() * 1000)) << _RANDOM_BITS)}"


def check_id_cursor(cursor: str, prefix: IdPrefix) -> str:
    """Check that a cursor may be the identifier of a row, as `make_page` gave it.

    Raises
    ------
    InvalidCursor
        If it has another form.
    """
    head, _, tail = cursor.partition("_")
    if head != prefix or not 1 <= len(tail) <= _LENGTH or not set(tail) <= set(_ALPHABET):
        raise InvalidCursor(cursor)
    return cursor


def _encode_base32(number: int) -> str:
    shifts = range(5 * (_LENGTH - 1), -1, -5)
    return "".join(_ALPHABET[number >> shift & 31] for shift in shifts)
