"""Read the body of a table of texts: fast for clean blocks, field by field to locate a fault."""

import csv
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from math import isinf, isnan, nan
from shlex import quote

import numpy as np
from numpy.typing import NDArray

from service.core.label_text import unescape_formula
from service.formats.limits import DEFAULT_LIMITS
from service.formats.tabular.cells import (
    BAD_WORDS,
    FLAGS,
    MISSING,
    begins_like_number,
    classify_cell,
)
from service.formats.tabular.table_layout import (
    MAX_FOOTER_ROWS,
    TableColumn,
    TableLayout,
    count_footer_rows,
    is_comment,
    split_blanks,
)
from sysid.core.errors import Advice, UnreadableFile
from sysid.core.types import FloatArray, IntArray

BLOCK_ROWS = 50_000
ColumnValues = FloatArray | NDArray[np.str_] | NDArray[np.datetime64]
"""Numbers, texts, or time stamps."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Columns with their values, and the row of the file of each sample.

    Attributes
    ----------
    columns : tuple of TableColumn
    values : tuple of ColumnValues
        Of each column.
    rows : IntArray
        From 1.
    sample_time : float or None
        Sampling period in s, if it was given.
    is_utc : bool
        Whether the time stamps of the times are in UTC; else they are local.
    bad_words : mapping
        How often each column has each word that marks a bad value.
    """

    columns: tuple[TableColumn, ...]
    values: tuple[ColumnValues, ...]
    rows: IntArray
    sample_time: float | None = None
    is_utc: bool = False
    bad_words: Mapping[tuple[str, str], int] = field(default_factory=dict)

    def find_values(self, name: str) -> ColumnValues:
        """Return the values of a column."""
        return self.values[[column.name for column in self.columns].index(name)]


def read_lines(
    lines: Iterable[str],
    layout: TableLayout,
    notes: list[str],
    max_rows: int = DEFAULT_LIMITS.messages,
) -> Table:
    """Read the body of a text; `lines` are all lines of the file.

    Empty fields and words such as ``NA`` become ``nan``: they are missing.

    Raises
    ------
    UnreadableFile
        If a row is ragged, a number is a text or infinite, or a time is missing; with row and
        column. Also if there are no rows, or more than `max_rows`.
    """
    body: Iterator[str] = islice(lines, layout.skipped, None)
    if layout.separator == " ":
        body = split_blanks(body)
    reader = csv.reader(body, delimiter=layout.separator, strict=True)
    try:
        return read_rows(reader, layout, notes, max_rows)
    except csv.Error as error:
        row = layout.skipped + reader.line_num
        raise UnreadableFile(f"this row cannot be read ({error})", row=row) from None


def read_rows(
    rows: Iterator[list[str]],
    layout: TableLayout,
    notes: list[str],
    max_rows: int = DEFAULT_LIMITS.messages,
) -> Table:
    """Read the rows of the body, which are split into fields; raises as `read_lines`."""
    blocks = []
    bad_words = Counter[tuple[str, str]]()
    comments, sign = 0, "." if layout.separator == "," else ""
    for fields, numbers, skipped in _iterate_blocks(rows, layout, notes):
        comments += skipped
        if numbers.size and numbers[-1] > max_rows + layout.skipped:
            raise UnreadableFile(f"the file has more than {max_rows} rows")
        if fields:
            fit = _fit_rows(fields, layout, numbers)
            sign = sign or _find_decimal_sign(fit, layout)
            parse = _parse_decimal_comma if sign == "," else _parse_decimal_point
            parsed = [
                _parse_column(column, cells, parse, numbers, bad_words)
                for column, cells in zip(layout.columns, fit, strict=True)
            ]
            blocks.append((parsed, numbers))
    if not blocks:
        raise UnreadableFile("there are no rows below the header")
    if comments:
        notes.append(f"comments in {comments} of the rows were skipped")
    if sign == ",":
        notes.append("decimal commas were read as decimal points")
    values = tuple(
        np.concatenate([block[i] for block, _ in blocks]) for i in range(len(layout.columns))
    )
    rows_of_samples = np.concatenate([numbers for _, numbers in blocks])
    return Table(layout.columns, values, rows_of_samples, layout.sample_time, bad_words=bad_words)


def _iterate_blocks(
    rows: Iterator[list[str]], layout: TableLayout, notes: list[str]
) -> Iterator[tuple[list[list[str]], IntArray, int]]:
    """Yield rows of data, their numbers, and how many comments were among them.

    Blank rows are left out, and words below the data.
    """
    rows_before, following = layout.skipped, list[list[str]]()
    while fields := [*following, *islice(rows, BLOCK_ROWS)]:
        following = list(islice(rows, MAX_FOOTER_ROWS))
        is_last = len(following) < MAX_FOOTER_ROWS
        if is_last:
            fields, following = fields + following, []
        numbers = np.arange(rows_before + 1, rows_before + 1 + len(fields))
        rows_before += len(fields)
        comments = 0
        filled = np.fromiter((any(map(str.strip, row)) for row in fields), bool, len(fields))
        for place in [i for i, row in enumerate(fields) if row and row[0][:1] in "#%/ "]:
            if filled[place] and is_comment(fields[place]):
                filled[place], comments = False, comments + 1
        if not filled.all():
            fields = [row for row, keep in zip(fields, filled, strict=True) if keep]
            numbers = numbers[filled]
        if is_last:
            fields, numbers = _cut_footer(fields, numbers, layout, notes)
        yield fields, numbers, comments


def _cut_footer(
    fields: list[list[str]], numbers: IntArray, layout: TableLayout, notes: list[str]
) -> tuple[list[list[str]], IntArray]:
    """Cut rows of words below the data, and tell which."""
    stop = len(fields) - count_footer_rows(fields, layout.columns)
    if stop == len(fields):
        return fields, numbers
    first, last = int(numbers[stop]), int(numbers[-1])
    rows = f"row {first} is" if first == last else f"rows {first} to {last} are"
    word = next(field for field in fields[stop] if field.strip())
    notes.append(f"{rows} below the data ({shorten_text(word.strip())}) and left out")
    return fields[:stop], numbers[:stop]


def _fit_rows(
    fields: list[list[str]], layout: TableLayout, numbers: IntArray
) -> list[tuple[str, ...]]:
    """Return the columns of rows, which all have the width of the header."""
    width = len(layout.columns)
    for place, (row, number) in enumerate(zip(fields, numbers, strict=True)):
        if len(row) != width:
            fields[place] = _pad_row(row, layout, int(number))
    return list(zip(*fields, strict=True))


def _find_decimal_sign(texts: Sequence[tuple[str, ...]], layout: TableLayout) -> str:
    """Find the decimal sign of the first number that has one; empty if all are whole."""
    numeric = [
        cells for column, cells in zip(layout.columns, texts, strict=True) if holds_numbers(column)
    ]
    if not any(sign in "".join(cells) for cells in numeric for sign in ".,"):
        return ""
    signs = (
        "," if "," in cell else "."
        for row in zip(*numeric, strict=True)
        for cell in row
        if ("," in cell or "." in cell) and classify_cell(cell) == "number"
    )
    return next(signs, "")


def _pad_row(row: list[str], layout: TableLayout, number: int) -> list[str]:
    """Fit a row whose last, nameless column is left out, or is empty; refuse any other."""
    width = len(layout.columns)
    if len(row) == width - 1 and layout.columns[-1].role == "nameless":
        return [*row, ""]
    if len(row) > width and not any(map(str.strip, row[width:])):
        return row[:width]
    hint = ""
    if layout.separator == "," and len(row) > width:
        hint = "; if commas are decimal signs, separate the columns by semicolons"
    raise UnreadableFile(
        f"this row has {len(row)} fields, but the header has {width}{hint}", row=number
    )


def parse_texts(
    column: TableColumn,
    texts: Sequence[str],
    numbers: IntArray,
    bad_words: Counter[tuple[str, str]],
) -> ColumnValues:
    """Parse a column of texts with decimal points, and count its words of bad values.

    Raises
    ------
    UnreadableFile
        As `read_lines`.
    """
    return _parse_column(column, texts, _parse_decimal_point, numbers, bad_words)


def _parse_column(
    column: TableColumn,
    texts: Sequence[str],
    convert: Callable[[str], float],
    numbers: IntArray,
    bad_words: Counter[tuple[str, str]],
) -> ColumnValues:
    if column.role == "label":
        return np.array([unescape_formula(text.strip()) for text in texts], dtype=np.str_)
    if not holds_numbers(column):
        return np.array([text.strip() for text in texts], dtype=np.str_)
    try:
        values = np.fromiter(map(convert, texts), np.float64, len(texts))
        if np.isfinite(values).all():
            return values
    except ValueError:
        pass  # parsed field by field below, to name the invalid field or to accept an empty one
    return np.array(
        [
            _parse_field(column, text, convert, int(number), bad_words)
            for text, number in zip(texts, numbers, strict=True)
        ]
    )


def holds_numbers(column: TableColumn) -> bool:
    """Whether the values of a column are to be numbers."""
    if column.role == "time":
        return column.kind not in ("stamp", "date", "clock")
    return column.role == "value"


def _parse_field(
    column: TableColumn,
    text: str,
    convert: Callable[[str], float],
    row: int,
    bad_words: Counter[tuple[str, str]],
) -> float:
    word = text.strip().lower()
    if column.role != "time" and (word in BAD_WORDS or word in column.bad_words):
        bad_words[column.name, text.strip()] += 1
        return nan
    try:
        value = nan if word in MISSING else FLAGS[word] if word in FLAGS else convert(text)
    except ValueError:
        raise UnreadableFile(
            f"found {shorten_text(text)}, which is not a number; ",
            _suggest_cause(text, column, convert),
            row=row,
            column=column.name,
        ) from None
    if isinf(value):
        raise UnreadableFile(
            f"found {shorten_text(text)}; values must be finite "
            "(an empty field is a missing value)",
            row=row,
            column=column.name,
        )
    if isnan(value) and column.role == "time":
        raise build_missing_time_error(text, row, column.name)
    return value


def build_missing_time_error(text: str, row: int, column: str) -> UnreadableFile:
    """Return the error of a row without its time."""
    return UnreadableFile(
        f"the time is missing (found {shorten_text(text)}); every row needs a time",
        row=row,
        column=column,
    )


def _parse_decimal_point(text: str) -> float:
    if "_" in text:  # Python would read 1_000 as a number
        raise ValueError(text)
    return float(text)


def _parse_decimal_comma(text: str) -> float:
    if "." in text or "_" in text:
        raise ValueError(text)
    return float(text.replace(",", "."))


def shorten_text(text: str) -> str:
    """Quote a text in a message, or its beginning."""
    return repr(text if len(text) <= 40 else text[:37] + "...")


def _suggest_cause(text: str, column: TableColumn, convert: Callable[[str], float]) -> Advice:
    if classify_cell(text) == "number" and ("." in text or "," in text):
        others = "commas" if convert is _parse_decimal_comma else "points"
        return Advice(
            f"decimal points and commas are mixed: other numbers of the file have {others}"
        )
    if "," in text and "." in text:
        return Advice(
            "decimal points and commas are mixed: write numbers without thousands separators"
        )
    if column.role == "time":
        return Advice("times are in seconds, or are date stamps in all rows")
    if not begins_like_number(text):
        word = text.strip()
        return Advice("if it marks a bad value, give ", "missing", f"={quote(word)}")
    return Advice(
        "leave the field empty if the value is missing; if the column is a label, name it in ",
        "segments",
    )
