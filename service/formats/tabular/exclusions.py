"""Exclude ranges of a table that the user names: ``t=100:200``, ``flow=90:``, ``state=Bad``.

Rows of a range of times, or with a word in a column of texts, are cut out. What follows is a
measurement of its own, since nobody knows what happened between. Values of a range are missing.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from service.formats.tabular.table_columns import Table
from sysid.core.errors import Advice, UnreadableFile, suggest_name
from sysid.core.types import BoolArray, FloatArray, IntArray
from sysid.data.table_rules import is_plain_time_name


class KeptRows(NamedTuple):
    """A table without excluded rows, its times (s), and the first row of each measurement."""

    table: Table
    times: FloatArray
    starts: IntArray


def exclude_ranges(kept: KeptRows, conditions: Sequence[str], notes: list[str]) -> KeptRows:
    """Exclude what the conditions name; each is told with its number of rows or values.

    Raises
    ------
    UnreadableFile
        If a condition names no column or no range, or nothing is left.
    """
    table, times, starts = kept
    values = list(table.values)
    is_cut = np.zeros(times.size, dtype=np.bool_)
    for condition in conditions:
        name, _, text = (part.strip() for part in condition.partition("="))
        place = _find_column(table, name, condition)
        column = table.columns[place]
        if column.role in ("time", "date"):
            found = _find_range(times, text, condition)
        elif values[place].dtype.kind == "U":
            found = np.asarray(np.char.lower(values[place].astype(np.str_)) == text.lower())
        else:
            found = _find_range(np.asarray(values[place], dtype=np.float64), text, condition)
            if column.role == "value":
                values[place] = np.where(found, np.nan, values[place])
                notes.append(f"{condition} excludes {np.count_nonzero(found)} values of {name!r}")
                continue
        is_cut |= found
        notes.append(
            f"{condition} excludes {np.count_nonzero(found)} rows; what follows is a measurement "
            "of its own"
        )
    if is_cut.all():
        raise _build_error(f"{', '.join(conditions)} excludes every row")
    return _cut_rows(replace(table, values=tuple(values)), times, starts, is_cut)


def _cut_rows(table: Table, times: FloatArray, starts: IntArray, is_cut: BoolArray) -> KeptRows:
    is_first = np.zeros(times.size, dtype=np.int64)
    is_first[starts[1:]] = 1
    parts = np.cumsum(is_first + is_cut)[~is_cut]
    firsts = np.flatnonzero(np.diff(parts, prepend=parts[:1] - 1))
    values = tuple(column[~is_cut] for column in table.values)
    return KeptRows(replace(table, values=values, rows=table.rows[~is_cut]), times[~is_cut], firsts)


def _find_column(table: Table, name: str, condition: str) -> int:
    """Find the column of a condition; ``t`` is the time whatever its name."""
    for place, column in enumerate(table.columns):
        if column.name == name or (column.role == "time" and is_plain_time_name(name)):
            return place
    names = [column.name for column in table.columns if column.name]
    raise _build_error(f"there is no column {name!r}{suggest_name(name, names)}", condition)


def _find_range(values: FloatArray, text: str, condition: str) -> BoolArray:
    """Find the values in a range such as ``100:200`` or ``90:``, or those equal to a number."""
    first, colon, last = text.partition(":")
    try:
        low = float(first or "-inf")
        high = float(last or "inf") if colon else low
    except ValueError:
        low, high = 1.0, 0.0
    if low > high or not text:
        raise _build_error(f"found {text!r}; need a range such as 100:200", condition)
    found: BoolArray = (values >= low) & (values <= high)
    return found


def _build_error(what: str, condition: str = "") -> UnreadableFile:
    return UnreadableFile(
        "", Advice("", "exclude", f" {condition}: {what}" if condition else f": {what}")
    )
