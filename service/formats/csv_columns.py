"""Read the body of a CSV file: fast for clean blocks, field by field to locate a fault."""

import csv
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from math import isinf, isnan

import numpy as np
from numpy.typing import NDArray

from service.core.text import unescape_formula
from service.formats.csv_layout import CsvColumn, CsvLayout
from service.formats.errors import InvalidUpload
from service.formats.limits import DEFAULT_LIMITS
from sysid.core.types import FloatArray

BLOCK_ROWS = 50_000
ColumnValues = FloatArray | NDArray[np.str_]


class CsvTable:
    """Columns of a file, and the row of the file of each sample."""

    def __init__(self, columns: dict[str, ColumnValues], rows: NDArray[np.int64]) -> None:
        self.columns, self.rows = columns, rows

    def parse_numbers(self, name: str) -> FloatArray:
        """Return the values of a column of numbers."""
        return np.asarray(self.columns[name], dtype=np.float64)


def read_columns(
    lines: Iterable[str], layout: CsvLayout, max_rows: int = DEFAULT_LIMITS.messages
) -> CsvTable:
    """Read all columns of the body; `lines` begin with the header.

    Empty fields and ``nan`` in value columns become ``nan``: they are missing.

    Raises
    ------
    InvalidUpload
        If a row is ragged, a number is a text or infinite, or a time is missing; with row and
        column. Also if there are no rows, or more than `max_rows`.
    """
    blocks = []
    for block in _iterate_blocks(lines, layout):
        blocks.append(block)
        if block[1][-1] > max_rows + 1:  # the header is row 1
            raise InvalidUpload(f"the file has more than {max_rows} rows")
    if not blocks:
        raise InvalidUpload("there are no rows below the header")
    rows = np.concatenate([block_rows for _, block_rows in blocks])
    columns = {
        column.name: np.concatenate([block[i] for block, _ in blocks])
        for i, column in enumerate(layout.columns)
    }
    return CsvTable(columns, rows)


def _iterate_blocks(
    lines: Iterable[str], layout: CsvLayout
) -> Iterator[tuple[list[ColumnValues], NDArray[np.int64]]]:
    reader = csv.reader(lines, delimiter=layout.separator, strict=True)
    rows_before = 0
    try:
        next(reader)
        rows_before = 1
        while fields := list(islice(reader, BLOCK_ROWS)):
            numbers = np.arange(rows_before + 1, rows_before + 1 + len(fields))
            rows_before += len(fields)
            filled = np.fromiter((any(map(str.strip, row)) for row in fields), bool, len(fields))
            if not filled.all():
                fields = [row for row, keep in zip(fields, filled, strict=True) if keep]
                numbers = numbers[filled]
            if fields:
                yield _parse_block(fields, layout, numbers), numbers
    except csv.Error as error:
        raise InvalidUpload(f"this row cannot be read ({error})", row=reader.line_num) from None


def _parse_block(
    fields: list[list[str]], layout: CsvLayout, numbers: NDArray[np.int64]
) -> list[ColumnValues]:
    width = len(layout.columns)
    for row, number in zip(fields, numbers, strict=True):
        if len(row) != width:
            hint = ""
            if layout.separator == "," and len(row) > width:
                hint = "; if commas are decimal signs, separate the columns by semicolons"
            raise InvalidUpload(
                f"this row has {len(row)} fields, but the header has {width}{hint}",
                row=int(number),
            )
    convert = _parse_decimal_comma if layout.has_decimal_commas else _parse_decimal_point
    return [
        _parse_column(column, texts, convert, numbers)
        for column, texts in zip(layout.columns, zip(*fields, strict=True), strict=True)
    ]


def _parse_column(
    column: CsvColumn,
    texts: tuple[str, ...],
    convert: Callable[[str], float],
    numbers: NDArray[np.int64],
) -> ColumnValues:
    if column.role == "label":
        return np.array([unescape_formula(text.strip()) for text in texts], dtype=np.str_)
    try:
        values = np.fromiter(map(convert, texts), np.float64, len(texts))
        if np.isfinite(values).all():
            return values
    except ValueError:
        pass  # parsed field by field below, to name the invalid field or to accept an empty one
    return np.array(
        [
            _parse_field(column, text, convert, int(number))
            for text, number in zip(texts, numbers, strict=True)
        ]
    )


def _parse_field(column: CsvColumn, text: str, convert: Callable[[str], float], row: int) -> float:
    try:
        value = convert(text) if text.strip() else float("nan")
    except ValueError:
        raise InvalidUpload(
            f"found {_shorten_text(text)}, which is not a number"
            f"{_suggest_cause(text, column, convert)}",
            row=row,
            column=column.name,
        ) from None
    if isinf(value):
        raise InvalidUpload(
            f"found {_shorten_text(text)}; values must be finite "
            "(an empty field is a missing value)",
            row=row,
            column=column.name,
        )
    if isnan(value) and column.role == "time":
        raise InvalidUpload(
            f"the time is missing (found {_shorten_text(text)}); every row needs a time in seconds",
            row=row,
            column=column.name,
        )
    return value


def _parse_decimal_point(text: str) -> float:
    if "_" in text:  # Python would read 1_000 as a number
        raise ValueError(text)
    return float(text)


def _parse_decimal_comma(text: str) -> float:
    if "." in text or "_" in text:
        raise ValueError(text)
    return float(text.replace(",", "."))


def _shorten_text(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _suggest_cause(text: str, column: CsvColumn, convert: Callable[[str], float]) -> str:
    if convert is _parse_decimal_comma and "." in text and not any(map(str.isalpha, text)):
        return "; decimal points and commas are mixed: other numbers of the file have commas"
    if "," in text and "." in text:
        return "; decimal points and commas are mixed"
    if column.role == "time":
        return "; times are in seconds"
    return (
        "; leave the field empty if the value is missing; if the column is a label, name it in "
        "segments"
    )
