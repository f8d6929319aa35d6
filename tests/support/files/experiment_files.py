"""One experiment as loggers, spreadsheets and other programs write it."""

import gzip
import io
import struct
import zipfile
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta

import numpy as np
from scipy.io import savemat

N = 240  # more than the first rows that are looked at
TIMES = np.arange(N) / 10.0
INPUT = np.repeat([0.0, 1.0, 0.5, 2.0], N // 4)
OUTPUT = np.round(np.sin(TIMES) - 1.25, 6)
START = datetime.fromisoformat("2026-03-14T23:59:58")  # the record goes on after midnight

_SHEET_PARTS = {
    "[Content_Types].xml": '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-'
    'types"><Default Extension="rels" ContentType="application/vnd.openxmlformats-package.'
    'relationships+xml"/><Override PartName="/xl/workbook.xml" ContentType="application/vnd.'
    'openxmlformats-officedocument.spreadsheetml.sheet.main+xml"/></Types>',
    "_rels/.rels": '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/'
    'relationships"><Relationship Id="r1" Type="http://schemas.openxmlformats.org/officeDocument/'
    '2006/relationships/officeDocument" Target="xl/workbook.xml"/></Relationships>',
}
_MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_LINKS = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"


def join_rows(
    header: str,
    separator: str = ",",
    *,
    time: Callable[[float], str] = lambda t: f"{t:.1f}",
    commas: bool = False,
    end: str = "",
) -> str:
    """The experiment as text: a header, and rows of time, input and output."""
    lines = [header]
    for t, u, y in zip(TIMES, INPUT, OUTPUT, strict=True):
        numbers = separator.join((f"{u:g}", f"{y:.6f}"))
        numbers = numbers.replace(".", ",") if commas else numbers
        lines.append(f"{time(t)}{separator}{numbers}{end}")
    return "\n".join(lines) + "\n"


def stamp(form: str, digits: int = 3) -> Callable[[float], str]:
    """Format a time as a date stamp; ``%f`` has so many digits."""

    def write(t: float) -> str:
        moment = START + timedelta(seconds=t)
        return moment.strftime(form.replace("%f", f"{moment.microsecond:06d}"[:digits]))

    return write


def write_sheet(rows: Sequence[Sequence[object]], sheets: Sequence[str] = ("Data",)) -> bytes:
    """An Excel file with the rows in its last sheet; the others have one text."""
    cells = [list(rows) if name == sheets[-1] else [["made by hand"]] for name in sheets]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in _SHEET_PARTS.items():
            archive.writestr(name, text)
        entries = "".join(
            f'<sheet name="{name}" sheetId="{i}" r:id="r{i}"/>' for i, name in enumerate(sheets, 1)
        )
        archive.writestr(
            "xl/workbook.xml",
            f'<workbook xmlns="{_MAIN}" xmlns:r="{_LINKS}"><sheets>{entries}</sheets></workbook>',
        )
        targets = "".join(
            f'<Relationship Id="r{i}" Type="{_LINKS}/worksheet" Target="worksheets/s{i}.xml"/>'
            for i in range(1, len(sheets) + 1)
        )
        package = "http://schemas.openxmlformats.org/package/2006/relationships"
        archive.writestr(
            "xl/_rels/workbook.xml.rels",
            f'<Relationships xmlns="{package}">{targets}</Relationships>',
        )
        for i, content in enumerate(cells, 1):
            body = "".join(f"<row>{''.join(map(_write_cell, row))}</row>" for row in content)
            archive.writestr(
                f"xl/worksheets/s{i}.xml",
                f'<worksheet xmlns="{_MAIN}"><sheetData>{body}</sheetData></worksheet>',
            )
    return buffer.getvalue()


def _write_cell(value: object) -> str:
    if isinstance(value, str):
        return f'<c t="inlineStr"><is><t>{value}</t></is></c>'
    return f"<c><v>{value!r}</v></c>"


def write_experiment_sheet(sheets: Sequence[str] = ("Data",)) -> bytes:
    """The experiment as an Excel file."""
    rows = zip(TIMES.tolist(), INPUT.tolist(), OUTPUT.tolist(), strict=True)
    return write_sheet([["t [s]", "u [V]", "y"], *rows], sheets)


def write_open_sheet(rows: Sequence[Sequence[object]]) -> bytes:
    """An OpenDocument spreadsheet (.ods) with the rows."""

    def write(value: object) -> str:
        if isinstance(value, str):
            content = f"<text:p>{value}</text:p>"
            return f'<table:table-cell office:value-type="string">{content}</table:table-cell>'
        return f'<table:table-cell office:value-type="float" office:value="{value!r}"/>'

    body = "".join(f"<table:table-row>{''.join(map(write, row))}</table:table-row>" for row in rows)
    name = "urn:oasis:names:tc:opendocument:xmlns"
    kind = "application/vnd.oasis.opendocument.spreadsheet"
    parts = {
        "mimetype": kind,
        "META-INF/manifest.xml": f'<manifest:manifest xmlns:manifest="{name}:manifest:1.0">'
        f'<manifest:file-entry manifest:full-path="/" manifest:media-type="{kind}"/>'
        "</manifest:manifest>",
        "content.xml": f'<office:document-content xmlns:office="{name}:office:1.0" '
        f'xmlns:table="{name}:table:1.0" xmlns:text="{name}:text:1.0"><office:body>'
        f'<office:spreadsheet><table:table table:name="Data">{body}</table:table>'
        "</office:spreadsheet></office:body></office:document-content>",
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for part, text in parts.items():
            archive.writestr(part, text)
    return buffer.getvalue()


def write_old_sheet(rows: Sequence[Sequence[object]]) -> bytes:
    """An Excel 97 file (.xls) with at most 64 kB of rows: BIFF8 records in a compound file."""

    def record(kind: int, content: bytes = b"") -> bytes:
        return struct.pack("<HH", kind, len(content)) + content

    def begin(kind: int) -> bytes:
        return record(0x0809, struct.pack("<4H2I", 0x0600, kind, 0, 0, 0, 0))

    def write(row: int, column: int, value: object) -> bytes:
        place = struct.pack("<3H", row, column, 0)
        if isinstance(value, str):
            text = struct.pack("<HB", len(value), 1) + value.encode("utf-16-le")
            return record(0x0204, place + text)
        return record(0x0203, place + struct.pack("<d", value))

    def list_entry(name: str, kind: int, child: int, start: int, size: int) -> bytes:
        text = name.encode("utf-16-le")
        head = struct.pack("<HBB3I", len(text) + 2, kind, 1, free, free, child)
        return text.ljust(64, b"\0") + head + bytes(36) + struct.pack("<IQ", start, size)

    free, end_of_chain, of_table, sector = 0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD, 512
    cells = [write(i, j, value) for i, row in enumerate(rows) for j, value in enumerate(row)]
    sheet = begin(0x0010) + b"".join(cells) + record(0x000A)
    opening, name = begin(0x0005), b"\x04\x00Data"
    start = len(opening) + 4 + 6 + len(name) + 4
    book = opening + record(0x0085, struct.pack("<IH", start, 0) + name) + record(0x000A) + sheet
    book = book.ljust(4096, b"\0")  # shorter streams are stored elsewhere
    book += bytes(-len(book) % sector)
    n = len(book) // sector  # then one sector with the folder, and one with the table of sectors
    folder = list_entry("Root Entry", 5, 1, end_of_chain, 0)
    folder += list_entry("Workbook", 2, free, 0, len(book)) + 2 * list_entry("", 0, free, 0, 0)
    chain = [*range(1, n), end_of_chain, end_of_chain, of_table]
    table = struct.pack("<128I", *chain, *[free] * (128 - len(chain)))
    head = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(16)
    head += struct.pack("<5H6x", 0x3E, 3, 0xFFFE, 9, 6)
    head += struct.pack("<9I", 0, 1, n, 0, 4096, end_of_chain, 0, end_of_chain, 0)
    return head + struct.pack("<109I", n + 1, *[free] * 108) + book + folder + table


def write_binary_sheet(rows: Sequence[Sequence[object]]) -> bytes:
    """A binary Excel file (.xlsb): BIFF12 records in a ZIP archive."""

    def write_number(number: int) -> bytes:
        return bytes([number]) if number < 128 else bytes([number & 127 | 128, number >> 7])

    def record(kind: int, content: bytes = b"") -> bytes:
        return write_number(kind) + write_number(len(content)) + content

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode("utf-16-le")

    def write(column: int, value: object) -> bytes:
        place = struct.pack("<2I", column, 0)
        if isinstance(value, str):
            return record(6, place + text(value))
        return record(5, place + struct.pack("<d", value))

    book = record(131) + record(143)
    book += record(156, struct.pack("<2I", 0, 1) + text("r1") + text("Data"))
    book += record(144) + record(132)
    size = struct.pack("<4I", 0, len(rows) - 1, 0, max(map(len, rows)) - 1)
    sheet = record(129) + record(148, size) + record(145)
    for number, row in enumerate(rows):
        sheet += record(0, struct.pack("<I", number) + bytes(13))
        sheet += b"".join(write(column, value) for column, value in enumerate(row))
    sheet += record(146) + record(130)
    links = "http://schemas.openxmlformats.org/package/2006/relationships"
    link = f'<Relationship Id="r1" Type="{_LINKS}/worksheet" Target="worksheets/s1.bin"/>'
    types = "http://schemas.openxmlformats.org/package/2006/content-types"
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{types}"/>',
        "xl/workbook.bin": book,
        "xl/_rels/workbook.bin.rels": f'<Relationships xmlns="{links}">{link}</Relationships>',
        "xl/worksheets/s1.bin": sheet,
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for part, content in parts.items():
            archive.writestr(part, content)
    return buffer.getvalue()


def write_npz(**arrays: object) -> bytes:
    """Arrays as a NumPy file."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def write_mat(content: dict[str, object], form: str = "5") -> bytes:
    """Arrays and structures as a MATLAB file."""
    buffer = io.BytesIO()
    savemat(buffer, content, format=form, do_compression=form == "5")
    return buffer.getvalue()


def write_parquet(**columns: object) -> bytes:
    """Columns as a Parquet file."""
    import polars as pl

    buffer = io.BytesIO()
    pl.DataFrame(columns).write_parquet(buffer)
    return buffer.getvalue()


def compress(text: str) -> bytes:
    """Text compressed by gzip."""
    return gzip.compress(text.encode())
