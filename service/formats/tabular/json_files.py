"""JSON as rows of texts: records, lines of records, and the answers of usual interfaces.

Read are ``[{"t": 0, "u": 1}, …]``, a record on each line, such a list inside an object, and lists
of lists of records, as Home Assistant answers. An object with a list of records for each signal, as
ThingsBoard exports it, is a long table. So is ``{"columns": […], "data": [[…], …]}`` of pandas and
InfluxDB. Objects inside a record give names with points.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NoReturn

from service.formats.read_options import ReadOptions
from service.formats.tabular.long_headings import names_signals
from service.formats.tabular.table_columns import Table, read_rows
from service.formats.tabular.table_layout import detect_sheet_layout
from sysid.core.errors import UnreadableFile

MAX_NESTING: Final = 4
"""Depth to which objects are opened."""

_NAMES: Final = ("columns", "fields", "header")
_ROWS: Final = ("data", "values", "rows")
_KEY: Final = "signal"

Record = dict[str, Any]


def read_json(path: Path, options: ReadOptions, notes: list[str]) -> Table:
    """Read the records of a JSON file; rows count records from 1.

    Raises
    ------
    UnreadableFile
        If it is no JSON, or holds no records.
    """
    rows = _find_rows(_parse(path))
    if len(rows) - 1 > options.limits.messages:
        raise UnreadableFile(f"the file has more than {options.limits.messages} records")
    try:
        layout = detect_sheet_layout(rows, options)
        table = read_rows(iter(rows[layout.skipped :]), layout, notes, options.limits.messages)
    except UnreadableFile as fault:
        row = None if fault.row is None else max(fault.row - 1, 1)
        raise UnreadableFile(fault.what, fault.advice, row=row, column=fault.column) from None
    return replace(table, rows=table.rows - 1)


def _parse(path: Path) -> Any:
    text = path.read_bytes()
    try:
        return json.loads(text.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise UnreadableFile("the file begins like JSON and is not UTF-8") from None
    except RecursionError:
        raise UnreadableFile("the JSON is nested too deeply") from None
    except json.JSONDecodeError as error:
        lines = text.decode("utf-8-sig").splitlines()
        if error.msg != "Extra data":
            _refuse_json(error)
    try:
        return [json.loads(line) for line in lines if line.strip()]
    except json.JSONDecodeError as error:
        _refuse_json(error)


def _refuse_json(error: json.JSONDecodeError) -> NoReturn:
    raise UnreadableFile(
        f"the file begins like JSON and is none: {error.msg}, line {error.lineno}, column "
        f"{error.colno}"
    ) from None


def _find_rows(document: Any) -> list[list[str]]:
    """Find the header and the rows of a document."""
    if isinstance(document, Mapping) and (rows := _find_named_rows(document)):
        return rows
    if _is_matrix(document):
        return [[_write_cell(cell) for cell in row] for row in document]
    records = _find_records(document, MAX_NESTING)
    if not records:
        raise UnreadableFile(
            "the JSON holds no list of records. Write one for each time: "
            '[{"t": 0, "u": 1, "y": 2}, …]. Or write columns of a CSV file: t,u,y'
        )
    flat = [dict(_flatten(record, "", MAX_NESTING)) for record in records]
    names = list(dict.fromkeys(name for record in flat for name in record))
    return [names, *([record.get(name, "") for name in names] for record in flat)]


def _is_matrix(document: Any) -> bool:
    is_list = isinstance(document, list) and len(document) > 0
    return is_list and all(
        isinstance(row, list) and row and not isinstance(row[0], list | Mapping) for row in document
    )


def _find_named_rows(document: Mapping[str, Any]) -> list[list[str]]:
    """Find names and rows that stand apart, also inside the first of several series."""
    names = next((document[name] for name in _NAMES if name in document), None)
    rows = next((document[name] for name in _ROWS if name in document), None)
    if isinstance(names, list) and isinstance(rows, list) and rows and _is_matrix(rows):
        texts = [
            name.get("name", name.get("text")) if isinstance(name, Mapping) else name
            for name in names
        ]
        return [[str(text) for text in texts], *([_write_cell(c) for c in row] for row in rows)]
    return []


def _find_records(document: Any, depth: int) -> list[Record]:
    """Find the records of a document; empty if there are none."""
    if isinstance(document, list):
        if document and all(isinstance(one, Mapping) for one in document):
            return list(document)
        parts = [_find_records(one, depth - 1) for one in document] if depth > 0 else []
        return [record for part in parts for record in _spread_names(part)]
    if not isinstance(document, Mapping) or depth == 0:
        return []
    found = {str(name): _find_records(one, depth - 1) for name, one in document.items()}
    full = {name: records for name, records in found.items() if records}
    if len(full) < 2:
        return next(iter(full.values()), [])
    return [{_KEY: name, **record} for name, records in full.items() for record in records]


def _spread_names(records: Sequence[Record]) -> list[Record]:
    """Give all records of a list the name of a signal that only the first one has."""
    first = records[0] if records else {}
    named = {name: value for name, value in first.items() if names_signals(name)}
    return [{**named, **record} for record in records]


def _flatten(record: Mapping[str, Any], prefix: str, depth: int) -> Iterator[tuple[str, str]]:
    for name, value in record.items():
        if isinstance(value, Mapping):
            if depth > 1:
                yield from _flatten(value, f"{prefix}{name}.", depth - 1)
        elif not isinstance(value, list):
            yield prefix + str(name), _write_cell(value)


def _write_cell(value: Any) -> str:
    """Write a value as a text file would have it; a number comes back bit for bit."""
    if value is None or isinstance(value, list | Mapping):
        return ""
    return (
        value
        if isinstance(value, str)
        else str(value).lower()
        if isinstance(value, bool)
        else repr(value)
    )
