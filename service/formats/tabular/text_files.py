"""Open a text file of any usual encoding, also compressed by gzip, as lines."""

import codecs
import gzip
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import BinaryIO, cast

from service.formats.file_kinds import GZIP_MAGIC, HEAD_BYTES
from service.formats.limits import UploadLimits
from sysid.core.errors import UnreadableFile

MAX_LINE_CHARACTERS = 1_000_000
_BLOCK_BYTES = 1 << 20
_NO_MEMORY = "Error -4 "
"""How `zlib.error` begins if zlib gets no memory (Z_MEM_ERROR of its manual)."""
_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_NOT_IN_WINDOWS_1252 = b"\x81\x8d\x8f\x90\x9d"
_MIN_NUL_SHARE = 0.6  # of every second byte; digits and signs of UTF-16 have one each


class _LimitedGzip(gzip.GzipFile):
    """A compressed file that ends in an error where its content exceeds a limit."""

    def __init__(self, source: BinaryIO, limit: int) -> None:
        super().__init__(fileobj=source, mode="rb")
        self._limit = limit

    def read(self, size: int | None = -1) -> bytes:
        return self._check(super().read(size))

    def read1(self, size: int = -1) -> bytes:
        return self._check(super().read1(size))

    def _check(self, data: bytes) -> bytes:
        if self.tell() > self._limit:
            raise UnreadableFile(
                f"the unpacked file has more than {self._limit} bytes; split the recording"
            )
        return data


@contextmanager
def open_text(
    source: Path | str | bytes, limits: UploadLimits, notes: list[str]
) -> Iterator[Iterator[str]]:
    """Open a text as its lines, with their line ends; a note tells an encoding that is guessed.

    Raises
    ------
    UnreadableFile
        If the file is no text, is damaged, or exceeds a limit. Also while its lines are read.
    """
    with BytesIO(source) if isinstance(source, bytes) else Path(source).open("rb") as file:
        is_compressed = file.read(2) == GZIP_MAGIC
        file.seek(0)
        binary = cast(BinaryIO, file)
        if is_compressed:
            binary = cast(BinaryIO, _LimitedGzip(binary, limits.file_bytes))
        try:
            encoding = _detect_encoding(binary, notes)
            binary.seek(0)
            with TextIOWrapper(binary, encoding=encoding, newline="") as stream:
                yield _iterate_lines(stream)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            if str(error).startswith(_NO_MEMORY):
                raise MemoryError from None
            raise UnreadableFile("the gzip data are damaged or cut off") from None


def _detect_encoding(binary: BinaryIO, notes: list[str]) -> str:
    head = binary.read(HEAD_BYTES)
    for mark, encoding in _MARKS:
        if head.startswith(mark):
            return encoding
    if b"\0" in head:
        return _detect_utf16(head)
    _refuse_control_signs(head)
    other = _find_other_encoding(binary, head)
    if other is None:
        return "utf-8-sig"
    name = "Windows-1252" if other == "cp1252" else "Latin-1"
    notes.append(f"the text is not UTF-8; it was read as {name}")
    return other


def _refuse_control_signs(head: bytes) -> None:
    odd = next((i for i, byte in enumerate(head) if byte < 32 and byte not in b"\t\n\r\f\x1a"), -1)
    if odd >= 0:
        raise UnreadableFile("the file is not text; need CSV or another text of columns", byte=odd)


def _find_other_encoding(binary: BinaryIO, head: bytes) -> str | None:
    """Find the encoding of a text of single bytes; None if it is UTF-8."""
    decoder, other = codecs.getincrementaldecoder("utf-8-sig")(), "cp1252"
    try:
        while head:
            decoder.decode(head)
            head = binary.read(_BLOCK_BYTES)
        decoder.decode(b"", final=True)
        return None
    except UnicodeDecodeError:
        while head:
            if any(byte in head for byte in _NOT_IN_WINDOWS_1252):
                other = "latin-1"
            head = binary.read(_BLOCK_BYTES)
        return other


def _detect_utf16(head: bytes) -> str:
    """Detect UTF-16 without a byte-order mark: every second byte of numbers is NUL."""
    half = len(head) // 2
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        signs = head[1 - first :: 2].count(0)
        if half and head[first::2].count(0) >= _MIN_NUL_SHARE * half and not signs:
            return encoding
    raise UnreadableFile(
        "the file is not text; need CSV or another text of columns", byte=head.index(b"\0")
    )


def _iterate_lines(stream: TextIOWrapper) -> Iterator[str]:
    number = 0
    try:
        while line := stream.readline(MAX_LINE_CHARACTERS + 1):
            number += 1
            if len(line) > MAX_LINE_CHARACTERS:
                raise UnreadableFile(
                    f"the row is longer than {MAX_LINE_CHARACTERS} characters", row=number
                )
            yield line.removesuffix("\x1a")
    except UnicodeError:
        raise UnreadableFile(
            f"the file is not {stream.encoding.upper()} text; save it as CSV in UTF-8",
            row=number + 1,
        ) from None
