"""Small files that unpack to very large ones: each ends at a limit, in one line."""

import io
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.formats.limits import DEFAULT_LIMITS, MIB
from service.formats.read_options import ReadOptions
from service.formats.recordings import read_with_notes
from sysid.core.errors import UnreadableFile
from tests.support.files.experiment_files import write_mat, write_parquet, write_sheet

MEMORY = "MiB of memory"


def refuse(folder: Path, content: bytes, **limits: Any) -> str:
    path = folder / "upload"
    path.write_bytes(content)
    assert len(content) < MIB
    with pytest.raises(UnreadableFile) as caught:
        read_with_notes(path, ReadOptions(limits=replace(DEFAULT_LIMITS, **limits)))
    assert "\n" not in caught.value.detail
    return caught.value.detail


def pack_zeros(head: bytes, size: int) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    parts = [packer.compress(head)]
    parts += [packer.compress(bytes(MIB)) for _ in range(size // MIB)]
    return b"".join((*parts, packer.flush()))


def pack_array(shape: tuple[int, ...], size: int = 0) -> bytes:
    """An .npz file whose array claims a shape and has so many bytes."""
    buffer = io.BytesIO()
    with (
        zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("t.npy", "w", force_zip64=True) as member,
    ):
        header = {"descr": "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(member, header)
        for _ in range(size // MIB):
            member.write(bytes(MIB))
    return buffer.getvalue()


def test_gzip_ends_at_the_size_of_a_file_and_of_a_line(tmp_path: Path) -> None:
    rows = b"t,u\n0,1\n" + b"\n" * 4 * MIB
    limits = {"file_bytes": 2 * MIB}
    assert "has more than 2097152 bytes" in refuse(tmp_path, pack_zeros(rows, 0), **limits)
    assert "longer than 1000000 char" in refuse(tmp_path, pack_zeros(b"t,u\n0,1\n" + b"1" * MIB, 0))
    rows = b"t,u\n" + b"".join(b"%d,1\n" % k for k in range(200_000))
    assert MEMORY in refuse(tmp_path, pack_zeros(rows, 0), memory_bytes=64 * MIB)
    assert "not text" in refuse(tmp_path, pack_zeros(b"\0", 8 * MIB), **limits)


def test_arrays_end_at_the_memory(tmp_path: Path) -> None:
    assert MEMORY in refuse(tmp_path, pack_array((10**12,)))
    size = 128 * MIB
    limits = {"memory_bytes": 180 * MIB}
    assert "no signal" in refuse(tmp_path, pack_array((MIB // 8,), MIB), **limits)
    assert MEMORY in refuse(tmp_path, pack_array((size // 8,), size), **limits)
    matlab = write_mat({"t": np.zeros(size // 8)})
    assert MEMORY in refuse(tmp_path, matlab, **limits)


def test_sheets_end_at_the_memory(tmp_path: Path) -> None:
    corner = write_sheet([["t", "u"], [0.0, 1.0]])
    with zipfile.ZipFile(io.BytesIO(corner)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    sheet = parts["xl/worksheets/s1.xml"]
    # Two cells in opposite corners are a table of 17 thousand million cells.
    far = b'<row r="1048576"><c r="XFD1048576"><v>1</v></c></row></sheetData>'
    parts["xl/worksheets/s1.xml"] = sheet.replace(b"</sheetData>", far)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    assert MEMORY in refuse(tmp_path, buffer.getvalue())


def test_parquet_ends_at_the_rows_and_at_the_memory(tmp_path: Path) -> None:
    zeros = np.zeros(4_000_000)
    content = write_parquet(t=zeros, **{f"u{i}": zeros for i in range(8)})
    assert "4000000 rows; at most" in refuse(tmp_path, content, messages=3_999_999)
    assert "has 9 columns" in refuse(tmp_path, content, channels=7)
    assert MEMORY in refuse(tmp_path, content, memory_bytes=600 * MIB)
