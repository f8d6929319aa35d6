"""Long tables: a row for each value, with the name of its signal, as historians export them.

``entity_id,state,last_changed`` of Home Assistant and ``Tag,Time,Value`` of a historian are such
tables, and so are rows of NONMEM by their ``DVID``. The column of names is known by its heading. A
column of texts is one too if the only signal has times that repeat or go back, and that increase
for each text alone.

In a table whose times repeat, each signal has the rows where it has a value, as in NONMEM, where a
point stands for none.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.formats.tabular.cells import classify_cell
from service.formats.tabular.long_headings import find_entry, names_signals
from service.formats.tabular.table_columns import Table, parse_texts
from service.formats.tabular.table_layout import TableColumn
from sysid.core.errors import UnreadableFile
from sysid.core.types import FloatArray, IntArray
from sysid.data.table_rules import CellKind, TimeAxis

_RESERVED: Final = ("id", "evid", "mdv", "cmt", "addl", "ii", "ss", "rate")
"""Data items of NONMEM that say what a row is."""
_STATES: Final = {"on": "1", "off": "0"}


class TableSignal(NamedTuple):
    """A signal of a table: where its rows are among those of the table, and its values."""

    name: str
    unit: str
    kind: CellKind
    rows: IntArray
    values: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LongTable:
    """A table with the places of its names, its values, and the units of values if it has them."""

    table: Table
    key: int
    entry: int
    unit: int | None = None

    @property
    def names(self) -> NDArray[np.str_]:
        """Name of the signal of each row."""
        return _read_names(self.table, self.key)


def find_long_table(table: Table, times: FloatArray, starts: IntArray) -> LongTable | None:
    """Find the columns of a long table; None if it is wide.

    Parameters
    ----------
    times : FloatArray
        Time of each row, s.
    starts : IntArray
        First row of each segment.
    """
    roles = [column.role for column in table.columns]
    if "key" in roles:
        unit = roles.index("unit") if "unit" in roles else None
        return LongTable(table, roles.index("key"), roles.index("entry"), unit)
    segments = _number_segments(times, starts)
    if "time" not in roles or _increases(times, segments):
        return None
    for place, column in enumerate(table.columns):
        others = [i for i, role in enumerate(roles) if role == "value" and i != place]
        if not _may_name(column, others) or not _divides(table, place, times, segments):
            continue
        entry = find_entry([table.columns[i].name for i in others])
        entry = others[0 if entry is None else entry]
        columns = list(table.columns)
        columns[place] = replace(column, role="key")
        columns[entry] = replace(columns[entry], role="entry")
        return LongTable(replace(table, columns=tuple(columns)), place, entry)
    return None


def _may_name(column: TableColumn, others: Sequence[int]) -> bool:
    """Whether a column may hold the names of signals: texts, or numbers below a usual heading."""
    if column.role == "text" and column.kind == "text":
        return len(others) == 1
    return column.role == "value" and len(others) >= 1 and names_signals(column.name)


def _number_segments(times: FloatArray, starts: IntArray) -> IntArray:
    is_first = np.zeros(times.size, dtype=np.int64)
    is_first[starts[1:]] = 1
    return np.cumsum(is_first)


def _increases(times: FloatArray, segments: IntArray) -> bool:
    """Whether times increase from row to row of a segment."""
    return bool(np.all(np.diff(times)[np.diff(segments) == 0] > 0))


def _divides(table: Table, place: int, times: FloatArray, segments: IntArray) -> bool:
    """Whether the times of each name increase, and each has more than one row on average."""
    _, codes = np.unique(_read_names(table, place), return_inverse=True)
    count = int(codes.max()) + 1
    if count < 2 or 2 * count > times.size:
        return False
    order = np.lexsort((np.arange(times.size), codes, segments))
    same = (np.diff(codes[order]) == 0) & (np.diff(segments[order]) == 0)
    return bool(np.all(np.diff(times[order])[same] > 0))


def _read_names(table: Table, place: int) -> NDArray[np.str_]:
    values = table.values[place]
    if values.dtype.kind == "U":
        return np.asarray(values, dtype=np.str_)
    name = table.columns[place].name
    texts = ["" if value != value else f"{name} {value:g}" for value in values.tolist()]
    return np.array(texts, dtype=np.str_)


def sort_rows(long: LongTable, clock: TimeAxis, starts: IntArray) -> tuple[LongTable, TimeAxis]:
    """Sort the rows of each segment by time, and count from the first of all.

    Raises
    ------
    UnreadableFile
        If the times are times of day without a date.
    """
    table, times = long.table, clock.seconds
    time = next(column for column in table.columns if column.role == "time")
    is_dated = any(column.role == "date" for column in table.columns)
    if time.kind == "clock" and not is_dated:
        raise UnreadableFile(
            "times of day do not tell the order of rows of several signals; write dates too, such "
            "as 2026-01-31 12:00:00",
            column=time.name,
        )
    order = np.lexsort((times, _number_segments(times, starts)))
    first = float(times[order[0]]) if starts.size == 1 and clock.started_at is not None else 0.0
    start = clock.started_at
    moved = TimeAxis(
        np.round(times[order] - first, 9) if first else times[order],
        start if start is None else start + timedelta(seconds=first),
        clock.unit,
    )
    values = tuple(column[order] for column in table.values)
    return replace(long, table=replace(table, values=values, rows=table.rows[order])), moved


def list_signals(long: LongTable, notes: list[str]) -> list[TableSignal]:
    """List the signals of a long table, in the order in which their names appear.

    Raises
    ------
    UnreadableFile
        If a value is neither a number nor a word of a bad value, or there is no signal.
    """
    names = long.names
    column = long.table.columns[long.entry]
    listed = list(dict.fromkeys(names[np.argsort(long.table.rows, kind="stable")].tolist()))
    if len(listed) == 1 and find_entry([column.name]) is None:
        names, listed = np.full(names.size, column.name), [column.name]  # a remark, not a name
    signals, texts = [], []
    bad_words = Counter[tuple[str, str]]()
    for name in filter(None, listed):
        rows = np.flatnonzero(names == name)
        values = _read_entries(long, rows, bad_words)
        if values is None:
            texts.append(name)
            continue
        known = np.isfinite(values)
        if known.any():
            unit = _read_unit(long, rows) or column.unit
            signals.append(TableSignal(name, unit, "number", rows[known], values[known]))
    key = long.table.columns[long.key].name
    if not signals:
        raise UnreadableFile(f"no name of column {key!r} has numbers in column {column.name!r}")
    notes.append(
        f"column {key!r} names the signals of column {column.name!r}; each has its own times: "
        f"{', '.join(signal.name for signal in signals)}"
    )
    if texts:
        notes.append(f"signals of words were left out: {', '.join(texts)}")
    if bad_words:
        found = ", ".join(f"{word!r} ({count})" for (_, word), count in bad_words.items())
        notes.append(f"rows whose word marks a bad value were left out: {found}")
    return signals


def _read_entries(
    long: LongTable, rows: IntArray, bad_words: Counter[tuple[str, str]]
) -> FloatArray | None:
    """Read the values of a signal; None if all are words."""
    values, column = long.table.values[long.entry][rows], long.table.columns[long.entry]
    if values.dtype.kind != "U":
        return np.asarray(values, dtype=np.float64)
    texts = [_STATES.get(text.lower(), text) for text in values.tolist()]
    numbers = [text for text in set(texts) if classify_cell(text) in ("number", "flag")]
    if not numbers:
        return None
    if any("," in text for text in numbers) and not any("." in text for text in numbers):
        texts = [text.replace(",", ".") for text in texts]
    number = replace(column, role="value", kind="number")
    return np.asarray(parse_texts(number, texts, long.table.rows[rows], bad_words))


def _read_unit(long: LongTable, rows: IntArray) -> str:
    """Read the unit of a signal, which all its rows have."""
    if long.unit is None:
        return ""
    units = {text for text in long.table.values[long.unit][rows].tolist() if text}
    return units.pop() if len(units) == 1 else ""


def list_wide_signals(
    table: Table, times: FloatArray, starts: IntArray, notes: list[str], *, is_sparse: bool
) -> list[TableSignal]:
    """List the signals that have a column of their own.

    Where times repeat in the rows of others, a signal has the rows with a value of its own. One of
    several values at a time is left out of a long table.
    """
    signals, crowded = [], []
    segments = _number_segments(times, starts)
    for column, values in zip(table.columns, table.values, strict=True):
        if column.role != "value":
            continue
        numbers = np.asarray(values, dtype=np.float64)
        rows = np.arange(numbers.size)
        if is_sparse and np.isfinite(numbers).any():
            rows = np.flatnonzero(np.isfinite(numbers))
            if not _increases(times[rows], segments[rows]):
                crowded.append(column.name)
                continue
        signals.append(TableSignal(column.name, column.unit, column.kind, rows, numbers[rows]))
    if crowded:
        notes.append(f"columns with several values at a time were left out: {', '.join(crowded)}")
    return signals


def has_sparse_rows(table: Table, times: FloatArray, starts: IntArray) -> bool:
    """Whether times repeat only because signals have rows of their own."""
    segments = _number_segments(times, starts)
    is_next = np.diff(segments, prepend=segments[:1]) == 0
    falls = np.diff(times, prepend=times[:1]) < 0
    segments = segments + np.cumsum(falls & is_next)  # a clock that restarts begins another one
    if not np.any(np.diff(times)[np.diff(segments) == 0] == 0):
        return False
    gaps = []
    for column, values in zip(table.columns, table.values, strict=True):
        if column.role != "value" or column.name.lower() in _RESERVED:
            continue
        numbers = np.asarray(values, dtype=np.float64)
        known = np.isfinite(numbers)
        if known.any() and not _increases(times[known], segments[known]):
            return False
        gaps.append(not known.all())
    return any(gaps)
