"""Which kind of file an upload is, by its first bytes; a name decides only what bytes cannot."""

import re
import struct
import zlib
from pathlib import Path
from typing import Literal

from sysid.core.errors import UnreadableFile

FileKind = Literal["csv", "mcap", "excel", "parquet", "numpy", "matlab", "json"]
"""``csv`` is every table in text, also compressed by gzip."""

HEAD_BYTES = 65_536
GZIP_MAGIC = b"\x1f\x8b"
SUFFIXES = (
    *(".csv", ".txt", ".tsv", ".dat", ".asc", ".gz", ".mcap", ".mat", ".npz", ".npy"),
    *(".xlsx", ".xlsm", ".xlsb", ".xls", ".ods", ".parquet", ".json", ".jsonl", ".ndjson"),
)
"""Suffixes of files that are read; any text is read whatever its suffix."""

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_USER_BLOCK = 512  # bytes of MATLAB before those of HDF5
_MAGICS: tuple[tuple[bytes, FileKind], ...] = (
    (b"\x89MCAP0\r\n", "mcap"),
    (b"PAR1", "parquet"),
    (b"\x93NUMPY", "numpy"),
    (b"MATLAB 5.0 MAT-file", "matlab"),
    (b"MATLAB 7.3 MAT-file", "matlab"),
    (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "excel"),  # .xls
)
_MATLAB_ADVICE = (
    "in MATLAB, save arrays with save('file.mat', 't', 'u', 'y', '-v7'); else export CSV"
)
_REFUSED_MAGICS: tuple[tuple[bytes, str, str], ...] = (
    (_HDF5_MAGIC, "an HDF5 file without the head of MATLAB", _MATLAB_ADVICE),
    (b"MDF ", "an ASAM MDF file", "export its signals as CSV or as MATLAB arrays"),
    (b"TDSm", "an NI TDMS file", "export its channels as CSV or Excel"),
    (b"ARROW1", "an Arrow (Feather) file", "write the table as Parquet"),
    (b"SQLite format 3", "an SQLite database", "export the table as CSV"),
    (b"RIFF", "a WAV or AVI file", "export its samples as CSV or as NumPy arrays"),
    (b"%PDF", "a PDF document", "export the table as CSV"),
    (b"\x89PNG", "a picture", "export the numbers as CSV"),
    (b"\xff\xd8\xff", "a picture", "export the numbers as CSV"),
    (b"BZh", "compressed by bzip2", "unpack it, or compress it by gzip"),
    (b"\xfd7zXZ", "compressed by xz", "unpack it, or compress it by gzip"),
    (b"\x28\xb5\x2f\xfd", "compressed by zstd", "unpack it, or compress it by gzip"),
    (b"7z\xbc\xaf\x27\x1c", "a 7-Zip archive", "unpack it"),
    (b"Rar!", "a RAR archive", "unpack it"),
)
_REFUSED_PATTERNS: tuple[tuple[re.Pattern[bytes], str, str], ...] = (
    (
        re.compile(rb"(\xef\xbb\xbf)?\s*<(\?xml|!doctype|html)", re.IGNORECASE),
        "XML or HTML",
        "export the table as CSV or Excel",
    ),
    (
        re.compile(rb"\x80[\x02-\x05](\x95|c|\])"),
        "a Python pickle",
        "write the table as Parquet or .npz",
    ),
)
_JSON = re.compile(rb'(\xef\xbb\xbf)?\s*(\{\s*["}]|\[\s*[\[{"\d+-])')
_SHEET_PARTS = (b"[Content_Types].xml", b"_rels/", b"docProps/", b"xl/")
_OPEN_SHEET = b"application/vnd.oasis.opendocument.spreadsheet"
_MAX_MAT4_NAME = 64


def detect_kind(path: Path, suffix: str = "") -> FileKind:
    """Detect the kind of a file.

    Parameters
    ----------
    path : Path
    suffix : str
        Suffix of the name that the user gave the file, ``.mcap``; it decides if the bytes do not.

    Raises
    ------
    UnreadableFile
        If the file is of a known kind that is not read; with the kind, and what to do.
    """
    return detect_head_kind(read_head(path), suffix.lower())


def read_head(path: Path) -> bytes:
    """Read the first bytes of a file."""
    with path.open("rb") as stream:
        return stream.read(HEAD_BYTES)


def detect_head_kind(head: bytes, suffix: str = "") -> FileKind:
    """Detect the kind of a file from its first bytes; see `detect_kind`."""
    if head.startswith(GZIP_MAGIC):
        return _check_compressed(head)
    for magic, kind in _MAGICS:
        if head.startswith(magic):
            return kind
    if head.startswith(b"PK\x03\x04"):
        return _detect_archive_kind(head)
    _refuse_other_kinds(head)
    if _JSON.match(head):
        return "json"
    if suffix == ".mcap":
        return "mcap"
    return "matlab" if suffix == ".mat" or _is_mat4(head) else "csv"


def _refuse_other_kinds(head: bytes) -> None:
    """Refuse a kind that is recognised and not read."""
    for magic, what, advice in _REFUSED_MAGICS:
        if head.startswith(magic) and not _is_plain_text(head):
            raise _build_refusal(what, advice)
    for pattern, what, advice in _REFUSED_PATTERNS:
        if pattern.match(head):
            raise _build_refusal(what, advice)


def _is_plain_text(head: bytes) -> bool:
    """Whether a text happens to begin with letters that mark another kind, such as RIFF."""
    return re.search(rb"[^\t\n\r\x20-\x7e]", head) is None


def _check_compressed(head: bytes) -> FileKind:
    try:
        inner = zlib.decompressobj(31).decompress(head, HEAD_BYTES)
    except zlib.error:
        raise UnreadableFile("the gzip data are damaged") from None
    if inner[257:262] == b"ustar":
        raise _build_refusal("a TAR archive", "unpack it")
    if inner.startswith(GZIP_MAGIC) or detect_head_kind(inner) != "csv":
        raise UnreadableFile("gzip is read around text only; unpack the file")
    return "csv"


def _detect_archive_kind(head: bytes) -> FileKind:
    """Detect the kind of a ZIP archive by its first entry."""
    length = int.from_bytes(head[26:28], "little")
    name, rest = head[30 : 30 + length], head[30 + length : 200 + length]
    if name.startswith(_SHEET_PARTS) or (name == b"mimetype" and _OPEN_SHEET in rest):
        return "excel"
    if name.endswith(b".npy"):
        return "numpy"
    raise _build_refusal("a ZIP archive", "unpack it")


def is_hdf5(path: Path) -> bool:
    """Whether a MATLAB file is of version 7.3."""
    return read_head(path)[_USER_BLOCK:].startswith(_HDF5_MAGIC)


def _is_mat4(head: bytes) -> bool:
    """Whether the file begins with the header of a MATLAB 4 matrix, which has no magic."""
    if len(head) < 20:
        return False
    for order in "<>":
        form, rows, columns, is_complex, length = struct.unpack_from(f"{order}5i", head)
        name = head[20 : 20 + max(0, min(length, _MAX_MAT4_NAME))]
        machine, reserved = form // 1000, form // 100 % 10
        if (
            machine == "<>".index(order)
            and reserved == 0
            and min(rows, columns) >= 0
            and is_complex in (0, 1)
            and len(name) > 1
            and name.endswith(b"\0")
            and name[:-1].isalnum()
        ):
            return True
    return False


def _build_refusal(what: str, advice: str) -> UnreadableFile:
    return UnreadableFile(f"the file is {what}, which is not read; {advice}")
