"""Spreadsheets as rows of texts: Excel (.xlsx, .xls, .xlsb) and OpenDocument (.ods)."""

from datetime import date, datetime, time, timedelta
from pathlib import Path

from python_calamine import CalamineError, CalamineSheet, CalamineWorkbook

from service.formats.read_options import ReadOptions
from service.formats.tabular.table_columns import Table, read_rows
from service.formats.tabular.table_layout import TableLayout, detect_sheet_layout
from sysid.core.errors import UnreadableFile

_EXACT_INTEGER = 2.0**53


def read_sheets(path: Path, options: ReadOptions, notes: list[str]) -> Table:
    """Read the first sheet that holds a table.

    Raises
    ------
    UnreadableFile
        If no sheet can be read; the fault is that of the first one.
    """
    try:
        book = CalamineWorkbook.from_path(path)
        sheets = [book.get_sheet_by_name(name) for name in book.sheet_names]
    except CalamineError as error:
        raise UnreadableFile(f"the spreadsheet cannot be opened ({error})") from None
    full = [sheet for sheet in sheets if sheet.height]
    faults, limits = [], options.limits
    for sheet in full:
        if sheet.height * max(sheet.width, 1) > limits.messages:
            raise UnreadableFile(f"sheet {sheet.name!r} has more than {limits.messages} cells")
        try:
            rows, layout = _find_table(sheet, options)
        except UnreadableFile as fault:
            faults.append(fault)
            continue
        if len(full) > 1:
            notes.append(f"sheet {sheet.name!r} was read, one of {len(full)} sheets")
        notes += layout.notes
        return read_rows(iter(rows[layout.skipped :]), layout, notes, limits.messages)
    raise faults[0] if faults else UnreadableFile("the spreadsheet is empty")


def _find_table(sheet: CalamineSheet, options: ReadOptions) -> tuple[list[list[str]], TableLayout]:
    rows = [[_write_cell(cell) for cell in row] for row in sheet.to_python(skip_empty_area=False)]
    rows = _cut_empty_columns(rows)
    return rows, detect_sheet_layout(rows, options)


def _cut_empty_columns(rows: list[list[str]]) -> list[list[str]]:
    """Cut columns at the left and the right that are empty in all rows."""
    full = [[i for i, cell in enumerate(row) if cell.strip()] for row in rows]
    first = min((places[0] for places in full if places), default=0)
    last = max((places[-1] for places in full if places), default=-1)
    return [row[first : last + 1] for row in rows]


def _write_cell(cell: float | str | date | time | timedelta) -> str:
    """Write a cell as a text file would have it; a number comes back bit for bit."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, datetime):
        return cell.isoformat(" ")
    if isinstance(cell, date | time):
        return cell.isoformat()
    if isinstance(cell, timedelta):
        return repr(cell.total_seconds())
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < _EXACT_INTEGER:
        return str(int(cell))
    return repr(cell)
