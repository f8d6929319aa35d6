"""One pass over the records of an MCAP file that may be damaged or hostile.

Nothing is trusted: neither the lengths, nor the summary, nor that there is an end. Every length is
compared with the remaining bytes and with a limit before a byte is read. Every stored checksum is
compared. A chunk is decompressed to its declared size and never beyond. See https://mcap.dev/spec
for the format.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, Final, NamedTuple, NoReturn

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from service.formats.limits import UploadLimits
from service.formats.mcap.mcap_writer import FOOTER_BODY, MCAP_MAGIC
from sysid.core.errors import UnreadableFile

_BLOCK_BYTES: Final = 1 << 20
RECORD_HEAD: Final = struct.Struct("<BQ")
_OPCODE_NAMES: Final = {int(opcode): opcode.name.lower().replace("_", " ") for opcode in Opcode}
_SUMMARY_OPCODES: Final = {
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
    Opcode.FOOTER,
}


class RawRecord(NamedTuple):
    """A record's opcode, its position in the file, and its content without opcode and length."""

    opcode: int
    byte: int
    body: bytes

    @property
    def name(self) -> str:
        """Name of the kind of record."""
        return describe_opcode(self.opcode)

    def raise_invalid(self, what: str) -> NoReturn:
        """Raise the error of this record."""
        raise UnreadableFile(f"the {self.name} record {what}", byte=self.byte)


def describe_opcode(opcode: int) -> str:
    """Return the name of a kind of record."""
    return _OPCODE_NAMES.get(opcode, f"unknown (0x{opcode:02x})")


class RecordCursor:
    """Reads the parts of one record; raises if a length exceeds the end of the record."""

    def __init__(self, record: RawRecord) -> None:
        self._record, self._at = record, 0

    def read_u16(self) -> int:
        """Read two bytes."""
        return int.from_bytes(self.read_bytes(2), "little")

    def read_u32(self) -> int:
        """Read four bytes."""
        return int.from_bytes(self.read_bytes(4), "little")

    def read_u64(self) -> int:
        """Read eight bytes."""
        return int.from_bytes(self.read_bytes(8), "little")

    def read_bytes(self, length: int) -> bytes:
        """Return the next `length` bytes."""
        body = self._record.body
        if length > len(body) - self._at:
            self._record.raise_invalid(
                f"declares an inner length of {length} bytes, but {len(body) - self._at} are left"
            )
        self._at += length
        return body[self._at - length : self._at]

    def read_text(self) -> str:
        """Read a text that is preceded by its length."""
        try:
            return self.read_bytes(self.read_u32()).decode()
        except UnicodeDecodeError:
            self._record.raise_invalid("has a text that is not UTF-8")

    def read_mapping(self) -> dict[str, str]:
        """Read texts by name, preceded by their total length."""
        end = self.read_u32() + self._at
        entries: dict[str, str] = {}
        while self._at < end:
            name = self.read_text()
            entries[name] = self.read_text()
        if self._at != end:
            self._record.raise_invalid("has a map whose entries go past its length")
        return entries


class CutOffFile(UnreadableFile):
    """A file that ends inside a record; the records before it are whole."""


class _CheckedStream:
    """The file as it is read: position, remaining bytes, checksum since the last reset."""

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream, self.size, self.at, self.crc = stream, size, 0, 0

    def read_exactly(self, length: int, what: str) -> bytes:
        left = self.size - self.at
        data = self._stream.read(length) if length <= left else b""
        if len(data) != length:
            raise CutOffFile(
                f"the file ends inside {what} ({length} bytes needed, {left} left); "
                "it is truncated. `mcap recover` writes what is whole to another file",
                byte=self.at,
            )
        self.crc = zlib.crc32(data, self.crc)
        self.at += length
        return data

    def has_only_zeros(self) -> bool:
        """Whether nothing but zeros is left; reads on."""
        while data := self._stream.read(_BLOCK_BYTES):
            if data.count(0) < len(data):
                return False
        return True


def iterate_records(binary: BinaryIO, size: int, limits: UploadLimits) -> Iterator[RawRecord]:
    """Yield every record of the data section, header first; then check the end.

    Raises
    ------
    CutOffFile
        If the file ends inside a record, or its rest was never written.
    UnreadableFile
        At the first invalid record; with the byte.
    """
    if size > limits.file_bytes:
        raise UnreadableFile(f"the file has {size} bytes; at most {limits.file_bytes} are read")
    stream = _CheckedStream(binary, size)
    if (
        size < len(MCAP_MAGIC)
        or stream.read_exactly(len(MCAP_MAGIC), "the magic bytes") != MCAP_MAGIC
    ):
        raise UnreadableFile("the file does not begin with the magic bytes of MCAP", byte=0)
    record = _read_record(stream, limits)
    if record.opcode != Opcode.HEADER:
        record.raise_invalid("stands where the header should be")
    while record.opcode != Opcode.DATA_END:
        if record.opcode == Opcode.FOOTER:
            record.raise_invalid("comes before the end of the data")
        yield record
        crc = stream.crc
        record = _read_record(stream, limits)
    _check_crc(record, RecordCursor(record).read_u32(), crc, "data section")
    _check_end(stream, limits)


def _read_record(stream: _CheckedStream, limits: UploadLimits) -> RawRecord:
    start = stream.at
    opcode, length = RECORD_HEAD.unpack(
        stream.read_exactly(RECORD_HEAD.size, "the head of a record")
    )
    if opcode == 0 and stream.has_only_zeros():
        raise CutOffFile("the rest of the file has zeros alone; it was never written", byte=start)
    if opcode == 0:
        raise UnreadableFile("a record has opcode 0, which is no record", byte=start)
    if length > limits.record_bytes:
        RawRecord(opcode, start, b"").raise_invalid(
            f"declares {length} bytes; at most {limits.record_bytes} are read"
        )
    return RawRecord(
        opcode, start, stream.read_exactly(length, f"the {describe_opcode(opcode)} record")
    )


def _check_end(stream: _CheckedStream, limits: UploadLimits) -> None:
    summary_start, stream.crc = stream.at, 0
    while True:
        start, crc = stream.at, stream.crc
        record = _read_record(stream, limits)
        if record.opcode < 0x80 and record.opcode not in _SUMMARY_OPCODES:
            record.raise_invalid("stands in the summary, after the end of the data")
        if record.opcode == Opcode.FOOTER:
            break
    fields = RecordCursor(record)
    declared = fields.read_u64()
    if declared not in (0, summary_start) or (declared == 0 and start != summary_start):
        record.raise_invalid(
            f"says that the summary begins at {declared}; it begins at {summary_start}"
        )
    head = RECORD_HEAD.pack(Opcode.FOOTER, FOOTER_BODY) + record.body[: FOOTER_BODY - 4]
    fields.read_u64()
    _check_crc(record, fields.read_u32(), zlib.crc32(head, crc), "summary")
    if stream.read_exactly(len(MCAP_MAGIC), "the closing magic bytes") != MCAP_MAGIC:
        raise UnreadableFile("the file does not end with the magic bytes of MCAP", byte=stream.at)
    if stream.at != stream.size:
        raise UnreadableFile("there are bytes after the end of the file's content", byte=stream.at)


def _check_crc(record: RawRecord, stored: int, computed: int, what: str) -> None:
    if stored not in (0, computed):  # 0: the writer computed none
        record.raise_invalid(
            f"has the checksum {stored:08x} for the {what}, but it is {computed:08x}: "
            "the file is damaged"
        )


def decompress_chunk(record: RawRecord, limits: UploadLimits) -> bytes:
    """Decompress the content of a chunk record.

    Raises
    ------
    UnreadableFile
        If its declared or actual size is too large, if it is damaged, or if the compression is
        unknown.
    """
    fields = RecordCursor(record)
    fields.read_u64(), fields.read_u64()  # first and last time, which the messages repeat
    size, crc, compression = fields.read_u64(), fields.read_u32(), fields.read_text()
    if size > limits.record_bytes:
        record.raise_invalid(
            f"declares {size} bytes of content; at most {limits.record_bytes} are read"
        )
    content = _decompress(record, compression, fields.read_bytes(fields.read_u64()), size)
    if len(content) != size:
        actual = "more" if len(content) > size else f"{len(content)}"
        record.raise_invalid(f"declares {size} bytes of content, but holds {actual}")
    if crc not in (0, zlib.crc32(content)):
        record.raise_invalid(
            f"has the checksum {crc:08x}, but its content has {zlib.crc32(content):08x}: "
            "it is damaged"
        )
    return content


def _decompress(record: RawRecord, compression: str, data: bytes, size: int) -> bytes:
    try:
        if compression == "zstd":
            # The window is memory too, and the header of a frame may request gigabytes of it.
            window = max(1 << 10, 1 << size.bit_length())
            reader = zstandard.ZstdDecompressor(max_window_size=max(window, 1 << 23))
            with reader.stream_reader(data) as stream:
                return bytes(stream.read(size + 1))
        if compression == "lz4":
            return _decompress_lz4(data, size)
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError) as error:
        record.raise_invalid(f"cannot be decompressed ({_take_first_line(error)}): it is damaged")
    if compression:
        record.raise_invalid(f"is compressed with {compression[:40]!r}; need zstd, lz4 or none")
    return data


def _decompress_lz4(data: bytes, size: int) -> bytes:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    parts: list[bytes] = []
    wanted = size + 1
    while wanted > 0 and not decompressor.eof:
        part = decompressor.decompress(data, max_length=wanted)
        if not part and not data:
            break
        parts.append(part)
        wanted, data = wanted - len(part), b""
    return b"".join(parts)


def _take_first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:80]
