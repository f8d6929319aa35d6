"""Detect the layout of a CSV file from its first rows: separator, decimal sign, names, units."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from service.core.text import unescape_formula
from service.formats.errors import InvalidUpload
from service.formats.limits import DEFAULT_LIMITS
from sysid.core.errors import suggest_name
from sysid.core.units import find_conversion_factor

SEPARATORS = ("\t", ";", ",")
TIME_NAMES = ("t", "t_s", "time", "time_s")
SECOND_NAMES = ("", "s", "sec", "second", "seconds")
MAX_TIME_UNIT = 86_400.0
"""Longest unit of time in s (a day); a longer one is taken for a mistake."""

_UNIT = re.compile(r"^(?P<name>.*?)\s*\[(?P<unit>[^\[\]]*)\]$")
_DECIMAL_COMMA = re.compile(r"^\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*$")

ColumnRole = Literal["time", "label", "value"]


@dataclass(frozen=True, slots=True)
class CsvColumn:
    """One column: its name without the unit, its unit and its role."""

    name: str
    unit: str
    role: ColumnRole


@dataclass(frozen=True, slots=True)
class CsvLayout:
    """Layout of a file."""

    columns: tuple[CsvColumn, ...]
    separator: str
    has_decimal_commas: bool

    @property
    def time_index(self) -> int | None:
        """Index of the time column, if there is one."""
        return next((i for i, column in enumerate(self.columns) if column.role == "time"), None)


def detect_layout(
    lines: Sequence[str],
    segments: Sequence[str],
    sample_time: float | None,
    max_channels: int = DEFAULT_LIMITS.channels,
) -> CsvLayout:
    """Detect the layout of a file from its first lines.

    Raises
    ------
    InvalidUpload
        If there is no usable header, if it has too many signals, or if the time is missing or given
        twice.
    """
    separator = _detect_separator(lines[0])
    reader = csv.reader(lines, delimiter=separator)
    try:
        header = next(reader)
        if len(header) - len(segments) - 1 > max_channels:  # not read any further
            raise _build_width_error(len(header), max_channels)
        rows = list(reader)
    except csv.Error as error:
        raise InvalidUpload(f"the first rows cannot be read ({error})") from None
    names = [_split_unit(field) for field in header]
    if len(names) == 1 and (sample_time is None or _is_number(header[0])):
        raise InvalidUpload(
            f"there is only one column ({header[0].strip()!r}); need a time column and a signal, "
            "separated by comma, semicolon or tab"
        )
    _check_names(names)
    columns = _assign_roles(names, segments, sample_time)
    signals = sum(column.role == "value" for column in columns)
    if signals == 0:
        raise InvalidUpload("there is no signal: every column is time or a label")
    if signals > max_channels:
        raise _build_width_error(len(header), max_channels)
    return CsvLayout(columns, separator, separator != "," and _has_decimal_commas(rows))


def _build_width_error(columns: int, max_channels: int) -> InvalidUpload:
    return InvalidUpload(
        f"the header has {columns} columns; at most {max_channels} signals are read", row=1
    )


def _detect_separator(header: str) -> str:
    unquoted = re.sub(r'"[^"]*"', "", header)
    return next((sign for sign in SEPARATORS if sign in unquoted), ",")


def _split_unit(field: str) -> tuple[str, str]:
    text = unescape_formula(field.strip())
    match = _UNIT.match(text)
    return (match["name"], match["unit"].strip()) if match else (text, "")


def _is_number(field: str) -> bool:
    try:
        float(field.replace(",", "."))
    except ValueError:
        return False
    return True


def _check_names(names: Sequence[tuple[str, str]]) -> None:
    if all(_is_number(name) for name, _ in names):
        raise InvalidUpload(
            "the first row holds numbers; need a header that names the columns, such as t,u,y",
            row=1,
        )
    seen: set[str] = set()
    for number, (name, _) in enumerate(names, 1):
        if not name:
            raise InvalidUpload(f"column {number} of the header has no name", row=1)
        if name in seen:
            raise InvalidUpload("two columns have this name; names must differ", row=1, column=name)
        seen.add(name)


def _assign_roles(
    names: Sequence[tuple[str, str]], segments: Sequence[str], sample_time: float | None
) -> tuple[CsvColumn, ...]:
    column_names = [name for name, _ in names]
    for label in segments:
        if label not in column_names:
            raise InvalidUpload(
                f"there is no label column {label!r}{suggest_name(label, column_names)}", row=1
            )
    is_time = [name.lower() in TIME_NAMES and name not in segments for name in column_names]
    time = is_time.index(True) if any(is_time) else None
    _check_time_column(None if time is None else names[time], column_names, sample_time)
    return tuple(
        CsvColumn(name, unit, "time" if i == time else "label" if name in segments else "value")
        for i, (name, unit) in enumerate(names)
    )


def _check_time_column(
    column: tuple[str, str] | None, column_names: Sequence[str], sample_time: float | None
) -> None:
    if column is None:
        if sample_time is None:
            raise InvalidUpload(
                f"there is no time column; found {', '.join(column_names)}. Name one of them t (in "
                "seconds), or give the sampling period with sample_time.",
                row=1,
            )
        if not 0 < sample_time < float("inf"):
            raise InvalidUpload(
                f"sample_time is {sample_time!r}; need a positive number of seconds"
            )
        return
    name, unit = column
    if sample_time is not None:
        raise InvalidUpload(
            "the file has this time column, and sample_time is given too; remove one of them",
            row=1,
            column=name,
        )
    if find_unit_seconds(unit) is None:
        raise InvalidUpload(
            f"times are in [{unit}]; need seconds, or another unit of time such as [ms] or [min]",
            row=1,
            column=name,
        )


def find_unit_seconds(unit: str) -> float | None:
    """Return the seconds in one unit of a time column; None if it is no unit of time."""
    if unit.lower() in SECOND_NAMES:
        return 1.0
    seconds = find_conversion_factor(unit, "s")
    return seconds if seconds is not None and 0 < seconds <= MAX_TIME_UNIT else None


def _has_decimal_commas(rows: Sequence[Sequence[str]]) -> bool:
    return any(_DECIMAL_COMMA.match(field) for row in rows for field in row)
