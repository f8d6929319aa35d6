"""Guess the layout of a table from its first rows: header, units, separator, roles.

The decimal sign follows from the body (`service.formats.tabular.table_columns`).

The longest run of rows of one width that hold numbers or time stamps is the data. The header is
the last row of that width before them; a row of units may lie between. Lines before the header are
a preamble. Rows that begin with ``#``, ``%`` or ``//`` are comments, and one of them may be the
header.
"""

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Final, Literal, NamedTuple, TypeVar

import numpy as np

from service.core.label_text import unescape_formula
from service.formats.advice import GIVE_PERIOD, name_columns
from service.formats.read_options import ReadOptions
from service.formats.tabular.cells import begins_like_number, classify_cell, classify_column
from service.formats.tabular.long_headings import find_long_places
from sysid.core.errors import Advice, UnreadableFile, suggest_name
from sysid.data.table_rules import (
    STAMP_KINDS,
    CellKind,
    Heading,
    counts_rows,
    find_time_column,
    find_time_unit,
    find_unit_seconds,
    is_index_name,
    is_nameless,
    is_plain_time_name,
    is_time_name,
    is_unit,
    split_headings,
)

SEPARATORS: Final = ("\t", ";", ",", "|", " ")
COMMENT_SIGNS: Final = ("#", "%", "//")
PEEK_ROWS = 200
"""First rows that are looked at, and twice as many while they hold no data."""
MAX_PEEK_ROWS = 3200
PEEK_CELLS = 40_000
"""Most cells of the first rows that are looked at."""
MAX_FOOTER_ROWS = 20
"""Most rows of words below the data, such as mean values; more are faults."""
_MAX_UNIT_CHARACTERS = 12
_MAX_LISTED = 8  # columns named in a message

_UNIT_FIELD = re.compile(r"^(\[.*\]|\(.*\))$")

_T = TypeVar("_T")
ColumnRole = Literal[
    "time", "date", "label", "value", "nameless", "text", "unused", "key", "entry", "unit"
]
"""``date`` completes a time of day; ``nameless``, ``text`` and ``unused`` are no signals.

In a long table ``key`` names the signal of a row, ``entry`` has its value and ``unit`` its unit.
"""


@dataclass(frozen=True, slots=True)
class TableColumn:
    """One column: its name without the unit, its unit, what it holds and its role.

    `bad_words` are those by which the user's file marks a bad value, in small letters.
    """

    name: str
    unit: str
    kind: CellKind
    role: ColumnRole
    bad_words: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class TableLayout:
    """Layout of a table.

    Attributes
    ----------
    columns : tuple of TableColumn
    separator : str
        Of the fields in a line; ``" "`` is any blanks, and empty if the rows are fields already.
    header_row : int
        Row of the header in the file, from 1.
    skipped : int
        Rows before the first row of data, or up to the header if there is none.
    sample_time : float or None
        Sampling period in s, if it was given.
    notes : tuple of str
    """

    columns: tuple[TableColumn, ...]
    separator: str
    header_row: int = 1
    skipped: int = 1
    sample_time: float | None = None
    notes: tuple[str, ...] = ()


class _Row(NamedTuple):
    """A row of fields, and its place among the rows of the file, from 0."""

    place: int
    fields: list[str]


class _DataBlock(NamedTuple):
    """The run of data under one separator, with the rows before it."""

    separator: str
    before: list[_Row]
    data: list[_Row]

    @property
    def width(self) -> int:
        return len(self.data[0].fields) if self.data else 0

    @property
    def has_header(self) -> bool:
        return any(len(row.fields) == self.width for row in self.before)


def detect_layout(lines: Iterator[str], options: ReadOptions) -> tuple[TableLayout, list[str]]:
    """Detect the layout of a text, and return the first lines, which were read for it.

    Raises
    ------
    UnreadableFile
        If there is no usable header, if it has too many signals, or if the time is missing or given
        twice. Also if the text is empty.
    """
    first: list[str] = []
    for first in _peek(lines):
        if not any(map(str.strip, first)):
            continue
        blocks = list(_find_text_blocks(first, options))
        if any(block.data for block in blocks):
            break
    if not first:
        raise UnreadableFile("the file is empty; need a header and rows, such as t,u,y")
    if not any(map(str.strip, first)):
        raise UnreadableFile("the first rows are empty; need a header such as t,u,y", row=1)
    block = _choose_block(blocks, first, len(options.columns))
    return _build_layout(block, options), first


def _find_text_blocks(lines: Sequence[str], options: ReadOptions) -> Iterator[_DataBlock]:
    """Find the data under each separator."""
    hint = re.match(r'"?sep=(.)"?\s*$', lines[0], re.IGNORECASE)
    for separator in (hint[1],) if hint else SEPARATORS:
        if hint or separator == " " or any(separator in line for line in lines):
            rows = _split_lines(lines[1:] if hint else lines, separator, int(bool(hint)))
            _check_width(rows, options)
            yield _find_block(rows, separator)


def detect_sheet_layout(rows: Iterable[list[str]], options: ReadOptions) -> TableLayout:
    """Detect the layout of rows that are split already; raises as `detect_layout`."""
    block = _DataBlock("", [], [])
    for first in _peek(iter(rows)):
        numbered = [_Row(place, fields) for place, fields in enumerate(first)]
        _check_width(numbered, options)
        block = _find_block(numbered, "")
        if block.data:
            break
    return _build_layout(block, options)


def _peek(rows: Iterator[_T]) -> Iterator[list[_T]]:
    """Yield the first rows, and all of more and more first rows while they are asked for."""
    first: list[_T] = []
    while len(first) < MAX_PEEK_ROWS and (more := list(islice(rows, len(first) or PEEK_ROWS))):
        first += more
        yield first


def split_blanks(lines: Iterable[str]) -> Iterator[str]:
    """Replace runs of blanks by one, so that each separates two fields."""
    return (" ".join(line.split()) + "\n" for line in lines)


def is_comment(fields: Sequence[str]) -> bool:
    """Whether a row is a comment."""
    return bool(fields) and fields[0].lstrip().startswith(COMMENT_SIGNS)


def _split_lines(lines: Sequence[str], separator: str, first: int) -> list[_Row]:
    reader = csv.reader(split_blanks(lines) if separator == " " else lines, delimiter=separator)
    rows, place, cells = [], first, 0
    try:
        for fields in reader:
            rows.append(_Row(place, _join_units(fields) if separator == " " else fields))
            place, cells = first + reader.line_num, cells + len(fields)
            if cells > PEEK_CELLS:
                break
    except csv.Error as error:
        raise UnreadableFile(f"the first rows cannot be read ({error})") from None
    return rows


def _join_units(fields: list[str]) -> list[str]:
    """Join the units of a header that blanks divide: ``Time (s) u (V)``."""
    joined: list[str] = []
    for field in fields:
        if joined and _UNIT_FIELD.match(field) and not _UNIT_FIELD.match(joined[-1]):
            joined[-1] += f" {field}"
        else:
            joined.append(field)
    return joined


def _check_width(rows: Sequence[_Row], options: ReadOptions) -> None:
    """Refuse a table that is too wide before its cells are looked at."""
    max_channels = options.limits.channels
    if rows and len(rows[0].fields) - len(options.segments) - 1 > max_channels:
        raise UnreadableFile(
            f"the header has {len(rows[0].fields)} columns; at most {max_channels} signals are "
            "read",
            row=rows[0].place + 1,
        )


def _find_block(rows: Sequence[_Row], separator: str) -> _DataBlock:
    """Find the longest run of rows of data, and the rows before it that are not blank."""
    full = [row for row in rows if any(map(str.strip, row.fields))]
    first, stop = _find_longest_run(full)
    if _has_words_among(full[:first], len(full[first].fields) if stop else 0):
        first = 1
    data = [row for row in full[first:stop] if not is_comment(row.fields)]
    data = data[: len(data) - _count_last_words([row.fields for row in data], 0)]
    if len(data) > 1 and not first and _is_header_of(data[0].fields, data[1].fields):
        return _DataBlock(separator, full[:1], data[1:])
    if not data:
        return _DataBlock(separator, list(full), [])
    return _DataBlock(separator, full[:first], data)


def _find_longest_run(rows: Sequence[_Row]) -> tuple[int, int]:
    """Find the first row of the longest run of data of one width, and the row after its last."""
    best: tuple[int, int] = (0, 0)
    start, width = 0, -1
    for number, row in enumerate(rows):
        if is_comment(row.fields):
            continue
        if _is_data(row.fields):
            if len(row.fields) != width:
                start, width = number, len(row.fields)
            if number + 1 - start > best[1] - best[0]:
                best = (start, number + 1)
        else:
            width = -1
    return best


def _has_words_among(rows: Sequence[_Row], width: int) -> bool:
    """Whether rows are a header of words, and below it rows of data among which words stand."""
    return (
        len(rows) > 1
        and all(len(row.fields) == width for row in rows)
        and set(map(classify_cell, rows[0].fields)) == {"text"}
        and all(set(map(classify_cell, row.fields)) - {"text", "empty"} for row in rows[1:])
    )


def _hides_separators(block: _DataBlock) -> bool:
    """Whether blanks divide a row that has other separators."""
    return block.separator == " " and any(
        separator in field for field in block.data[0].fields for separator in SEPARATORS[:-1]
    )


def count_footer_rows(rows: Sequence[Sequence[str]], columns: Sequence[TableColumn]) -> int:
    """Count the rows at the end of a table that are no samples, such as ``Mean,0.5,1.2``.

    They have words where the time stands, or the first signal of a table without times. More than
    `MAX_FOOTER_ROWS` are none: they are faults.
    """
    roles = [column.role for column in columns]
    place = next((roles.index(role) for role in ("time", "value") if role in roles), 0)
    count = _count_last_words(rows, place)
    return count if count <= MAX_FOOTER_ROWS else 0


def _count_last_words(rows: Sequence[Sequence[str]], place: int) -> int:
    """Count the last rows that begin with a word and have no value at a place.

    None if the first row has no value there either.
    """
    if not rows or not _has_value(rows[0], place):
        return 0
    return next(
        count
        for count, row in enumerate(reversed(rows))
        if _has_value(row, place) or not _begins_with_word(row)
    )


def _has_value(fields: Sequence[str], place: int) -> bool:
    return place < len(fields) and classify_cell(fields[place]) not in ("text", "empty")


def _begins_with_word(fields: Sequence[str]) -> bool:
    first = next((field for field in fields if field.strip()), "")
    return classify_cell(first) == "text" and not begins_like_number(first)


def _is_data(fields: Sequence[str]) -> bool:
    """Whether a row is one of data: its first field is, most are, or one is a time stamp."""
    kinds = [kind for kind in map(classify_cell, fields) if kind != "empty"]
    count = sum(kind != "text" for kind in kinds)
    return count > 0 and (kinds[0] != "text" or 2 * count > len(kinds) or "stamp" in kinds)


def _is_header_of(fields: Sequence[str], below: Sequence[str]) -> bool:
    """Whether a row of numbered names such as ``t,1,2`` heads the row below."""
    kinds = zip(map(classify_cell, fields), map(classify_cell, below), strict=True)
    return any(kind == "text" and other not in ("text", "empty") for kind, other in kinds)


def _choose_block(blocks: Sequence[_DataBlock], lines: Sequence[str], named: int) -> _DataBlock:
    """Choose the separator under which the data have a header, then the longest and the widest.

    If the user named columns, the one comes first under which there are so many.
    """
    found = [block for block in blocks if block.data and block.width > 1]
    if found:
        return max(
            found,
            key=lambda one: (
                one.width == named and not _hides_separators(one),
                one.has_header,
                len(one.data),
                one.width,
            ),
        )
    single = next((block for block in blocks if block.data), None)
    if single is not None:
        return single._replace(separator=single.separator.strip(" ") or ",")
    if all(separator not in "".join(lines) for separator in SEPARATORS[:-1]):
        return next(
            (block for block in blocks if block.before and len(block.before[0].fields) > 1),
            _DataBlock(",", _find_block(_split_lines(lines, ",", 0), ",").before, []),
        )
    return blocks[0]


def _build_layout(block: _DataBlock, options: ReadOptions) -> TableLayout:
    if not block.data:
        raise _build_no_table_error(block)
    cells = [row.fields for row in block.data]
    if options.columns:
        header, names = block.data[0], list(options.columns)
        units = list[str]()
        if len(names) == block.width - 1 and not any(row[-1].strip() for row in cells):
            names.append("")  # each row ends with a separator
        check_count(names, block.width, _may_be_times(cells))
    else:
        header, units, names = _find_header(block)
        names, cells = _align_header(names, cells)
    headings = [
        Heading(name, unit, classify_cells([row[i] for row in cells], name))
        for i, (name, unit) in enumerate(read_headings(names, units))
    ]
    row = header.place + 1
    if options.columns:
        return _build_named_layout(block, headings, options)
    if len(headings) == 1 and (options.sample_time is None or _is_number(names[0])):
        raise _build_narrow_error(names[0])
    columns = assign_roles(headings, options, row)
    notes = []
    preamble = [r for r in block.before if r.place < header.place and not is_comment(r.fields)]
    if preamble:
        notes.append(f"the header is in row {row}; the lines before it were skipped")
    if units:
        notes.append(f"row {row + 1} was read as the units of the columns")
    skipped = block.data[0].place if block.data else header.place + 1
    return TableLayout(columns, block.separator, row, skipped, options.sample_time, tuple(notes))


def _build_named_layout(
    block: _DataBlock, headings: Sequence[Heading], options: ReadOptions
) -> TableLayout:
    """Build the layout of data below no header, whose columns the user named."""
    first = block.data[0].place
    columns = assign_roles(headings, options, None)
    lines = [row for row in block.before if not is_comment(row.fields)]
    notes = (f"the lines before row {first + 1} were skipped",) if lines else ()
    return TableLayout(columns, block.separator, first, first, options.sample_time, notes)


def check_count(names: Sequence[str], count: int, has_times: bool) -> None:
    """Check that the user named each column.

    Raises
    ------
    UnreadableFile
        If there are more or fewer names.
    """
    if len(names) != count:
        advice = name_columns(count, has_times=has_times)
        raise UnreadableFile(
            f"the table has {count} columns, and {len(names)} names are given; ",
            advice._replace(after=f"{advice.after}. An empty name leaves a column out"),
        )


def _may_be_times(cells: Sequence[Sequence[str]]) -> bool:
    """Whether the first column may be the time: it holds stamps, or only increases."""
    texts = [row[0] for row in cells]
    if classify_column(texts) in STAMP_KINDS:
        return True
    try:
        times = np.array([float(text.replace(",", ".")) for text in texts])
    except ValueError:
        return False
    return len(texts) > 1 and bool(np.all(np.diff(times) > 0))


def classify_cells(cells: Sequence[str], name: str) -> CellKind:
    """Return what a column holds; one without a name of its own may count rows."""
    kind = classify_column(cells)
    is_count = kind == "number" and is_index_name(name) and counts_rows(cells)
    return "count" if is_count else kind


def _find_header(block: _DataBlock) -> tuple[_Row, list[str], list[str]]:
    """Find the header before the data, the row of units below it, and the names."""
    rows = [row for row in block.before if not is_comment(row.fields)]
    fit = [row for row in rows if abs(len(row.fields) - block.width) <= 1]
    fit = fit or [row for row in rows[-1:] if len(row.fields) > 1]
    same = [row for row in fit if len(row.fields) == block.width] or fit
    if same:
        last = same[-1]
        _check_widths(rows, last, block.width)
        above = same[-2] if len(same) > 1 else None
        if above is not None and _is_unit_row(last.fields, above.fields):
            return above, last.fields, above.fields
        return last, [], last.fields
    for row in reversed(block.before):
        names = _split_comment(row.fields, block)
        if len(names) == block.width and not all(map(_is_number, names)):
            return row, [], names
    first = block.data[0]
    if block.width == 1:
        raise _build_narrow_error(first.fields[0])
    raise _build_header_error(
        first.place + 1, block.width, _may_be_times([row.fields for row in block.data])
    )


def _check_widths(rows: Sequence[_Row], last: _Row, width: int) -> None:
    """Refuse a row of another width amid the data, of which `last` is one: no header has values."""
    if "text" in map(classify_cell, last.fields):
        return
    full = [row for row in rows if len(row.fields) == width]
    header = next((row for row in full if "text" in map(classify_cell, row.fields)), None)
    if header is None:
        return
    for row in rows:
        if row.place > header.place and len(row.fields) != width:
            raise UnreadableFile(
                f"this row has {len(row.fields)} fields, but the header has {width}",
                row=row.place + 1,
            )


def _build_header_error(row: int | None, count: int, has_times: bool) -> UnreadableFile:
    return UnreadableFile(
        "the first row holds numbers, so the file has no header; ",
        name_columns(count, has_times=has_times),
        row=row,
    )


def _build_no_table_error(block: _DataBlock) -> UnreadableFile:
    """Return the error of a file without a row of numbers: a lone header, or no table."""
    rows = [row for row in block.before if not is_comment(row.fields)]
    if len(rows) < 2 and any(len(row.fields) > 1 for row in rows):
        return UnreadableFile("there are no rows below the header")
    return UnreadableFile(
        "this is not a table: no row has numbers. Need a header and rows of numbers, such as t,u,y"
    )


def _build_narrow_error(name: str) -> UnreadableFile:
    return UnreadableFile(
        f"there is only one column ({name.strip()!r}); need a time column and a signal, separated "
        "by comma, semicolon, tab or blanks"
    )


def _split_comment(fields: Sequence[str], block: _DataBlock) -> list[str]:
    """Split a comment that may be the header: ``# t u y``, also above columns with commas."""
    sign = block.separator or ","
    text = sign.join(fields).lstrip()
    for mark in COMMENT_SIGNS:
        text = text.lstrip(mark)
    for separator in (sign, *SEPARATORS):
        rows = _split_lines([text.strip()], separator, 0)
        if rows and len(rows[0].fields) == block.width:
            return [field.strip() for field in rows[0].fields]
    return []


def _is_unit_row(fields: Sequence[str], names: Sequence[str]) -> bool:
    """Whether a row holds the units of the columns above: ``s,V,degC`` or ``(ms),(V),``."""
    units = [_strip_brackets(field) for field in fields]
    full = [unit for unit in units if unit]
    times = [
        unit
        for unit, name in zip(units, names, strict=False)
        if is_time_name(split_headings([name])[0][0])
    ]
    if not times and any(map(is_plain_time_name, full)):
        return False  # it names the time, and the row above does not
    return (
        bool(full)
        and all(len(unit) <= _MAX_UNIT_CHARACTERS for unit in full)
        and (not times or any(find_unit_seconds(unit) is not None for unit in times))
        and 2 * sum(map(is_unit, full)) > len(full)
    )


def _strip_brackets(text: str) -> str:
    text = text.strip()
    return text[1:-1].strip() if text[:1] + text[-1:] in ("[]", "()") else text


def _align_header(names: list[str], cells: list[list[str]]) -> tuple[list[str], list[list[str]]]:
    """Give a name to columns without one: blank ends of rows, and an index before the columns."""
    width = len(cells[0]) if cells else len(names)
    if width == len(names) + 1:
        if not any(row[-1].strip() for row in cells):
            return [*names, ""], cells
        if counts_rows([row[0] for row in cells]):
            return ["", *names], cells
    return names, cells if width == len(names) else []


def read_headings(names: Sequence[str], units: Sequence[str] = ()) -> list[tuple[str, str]]:
    """Split the names of columns into name and unit; `units` are those of a row below them."""
    split = split_headings([unescape_formula(name.strip()) for name in names])
    if not units:
        return split
    return [
        (name, unit or _strip_brackets(below))
        for (name, unit), below in zip(split, units, strict=False)
    ]


def _is_number(field: str) -> bool:
    try:
        float(field.replace(",", "."))
    except ValueError:
        return False
    return True


def assign_roles(
    headings: Sequence[Heading], options: ReadOptions, row: int | None = 1
) -> tuple[TableColumn, ...]:
    """Give each column its role.

    Raises
    ------
    UnreadableFile
        If a name is missing or occurs twice, a label column is missing, or there is no signal or no
        time. Also if the time is given twice.
    """
    bad_words = frozenset(word.lower() for word in options.missing)
    named = [
        TableColumn(*heading, _find_role(heading, is_named=bool(options.columns)), bad_words)
        for heading in headings
    ]
    _check_names(named, options, row)
    columns = [
        replace(column, role="label" if column.name in options.segments else column.role)
        for column in named
    ]
    names = [column.name for column in columns]
    for label in options.segments:
        if label not in names:
            raise UnreadableFile(
                f"there is no label column {label!r}{suggest_name(label, names)}", row=row
            )
    columns = _assign_time(columns, options.sample_time, row)
    if options.sample_time is None:
        columns = _assign_long_roles(columns)
    columns = [
        replace(c, role="text") if c.role == "value" and c.kind in ("text", *STAMP_KINDS) else c
        for c in columns
    ]
    for number, column in enumerate(columns, 1):
        if column.role == "nameless" and column.kind not in ("empty", "count"):
            raise build_nameless_error(number, row)
    signals = sum(column.role == "value" for column in columns)
    if signals == 0 and not any(column.role in ("text", "entry") for column in columns):
        raise UnreadableFile("there is no signal: every column is time or a label")
    if signals > options.limits.channels:
        raise UnreadableFile(
            f"the header has {len(headings)} columns; at most {options.limits.channels} signals "
            "are read",
            row=row,
        )
    return tuple(columns)


def _assign_long_roles(columns: Sequence[TableColumn]) -> list[TableColumn]:
    """Give the columns of a long table their roles, if names of signals stand below a heading."""
    places = find_long_places(
        [
            Heading(column.name, column.unit, column.kind) if column.role == "value" else None
            for column in columns
        ]
    )
    roles = list(columns)
    if places is not None:
        roles[places.key] = replace(columns[places.key], role="key")
        roles[places.entry] = replace(columns[places.entry], role="entry")
        if places.unit is not None:
            roles[places.unit] = replace(columns[places.unit], role="unit")
    return roles


def _find_role(heading: Heading, *, is_named: bool) -> ColumnRole:
    """Find the first role of a column; one that the user gave no name is unused."""
    if is_named:
        return "value" if heading.name else "unused"
    return "nameless" if is_nameless(heading) else "value"


def build_nameless_error(number: int, row: int | None = 1) -> UnreadableFile:
    """Return the error of a column of values without a name."""
    return UnreadableFile(f"column {number} of the header has no name", row=row)


def _check_names(columns: Sequence[TableColumn], options: ReadOptions, row: int | None) -> None:
    if not options.columns and all(_is_number(column.name) for column in columns):
        raise _build_header_error(row, len(columns), has_times=False)
    seen: set[str] = set()
    for column in columns:
        if column.name in seen and column.name:
            raise UnreadableFile(
                "two columns have this name; names must differ", row=row, column=column.name
            )
        seen.add(column.name)


def _list_columns(columns: Sequence[TableColumn]) -> str:
    """List the columns of a table in which none is a time, as the end of a sentence."""
    found = [one.name for one in columns if one.name and one.role != "label"]
    more = len(found) - _MAX_LISTED
    names = ", ".join(found[:_MAX_LISTED]) + (f" and {more} more" if more > 0 else "")
    if labels := ", ".join(one.name for one in columns if one.role == "label"):
        names += f", and {labels} as labels of segments, one measurement each"
    counts = next((one.name for one in columns if one.kind == "count"), "")
    return f"{names.rstrip('.')}." + (f" Column {counts!r} only counts rows." if counts else "")


def _assign_time(
    columns: Sequence[TableColumn], sample_time: float | None, row: int | None
) -> list[TableColumn]:
    """Give their roles to the column of times, and to that of dates beside times of day."""
    time = find_time_column(
        [
            Heading(column.name, column.unit, column.kind)
            if column.role in ("value", "nameless")
            else None
            for column in columns
        ],
        has_period=sample_time is not None,
    )
    if time is None:
        if sample_time is None:
            raise UnreadableFile(
                f"there is no time column; found {_list_columns(columns)} Name one of them t (in "
                "seconds), or ",
                GIVE_PERIOD,
                row=row,
            )
        return list(columns)
    column = columns[time]
    name, unit = column.name, find_time_unit(column.name, column.unit)
    if sample_time is not None and column.kind not in STAMP_KINDS:
        raise UnreadableFile(
            "the file has this time column. Remove it, or ",
            Advice("leave out ", "sample_time"),
            row=row,
            column=name,
        )
    if column.kind in STAMP_KINDS:
        unit = ""
    elif find_unit_seconds(unit) is None:
        raise UnreadableFile(
            f"times are in [{unit}]; need seconds, or another unit of time such as [ms] or [min]",
            row=row,
            column=name,
        )
    roles = list(columns)
    other = _find_other_half(columns, time)
    if other is not None:
        date, time = (other, time) if columns[other].kind == "date" else (time, other)
        roles[date] = replace(columns[date], role="date")
    roles[time] = replace(
        columns[time], role="time", unit=unit, name=columns[time].name or "(no name)"
    )
    return roles


def _find_other_half(columns: Sequence[TableColumn], time: int) -> int | None:
    """Find the column of dates of a column of times of day, or the reverse."""
    wanted = {"clock": "date", "date": "clock"}.get(columns[time].kind)
    return next(
        (
            i
            for i, column in enumerate(columns)
            if column.kind == wanted and column.role in ("value", "nameless")
        ),
        None,
    )
