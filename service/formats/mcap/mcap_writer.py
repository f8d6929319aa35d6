"""Write the MCAP file format: records of `mcap`, but chunks as NumPy arrays.

See https://mcap.dev/spec for the format. Each chunk holds the messages of one channel. All have the
same size, because every field is written, zeros too. So a chunk is one structured array.
"""

import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from service.formats.limits import DEFAULT_LIMITS
from service.formats.mcap.mcap_messages import (
    MESSAGE_HEADER,
    NumericField,
    build_schema,
    encode_tag_value,
    make_double_fields,
    make_identifiers,
    make_record_dtype,
)
from service.formats.mcap.topics import Nanoseconds
from sysid.core.types import FloatArray

MCAP_MAGIC: Final = b"\x89MCAP0\r\n"
CHUNK_SAMPLES: Final = 16_384
CHUNK_BYTES: Final = DEFAULT_LIMITS.record_bytes // 2  # a chunk may not become smaller
LIBRARY: Final = "lagid"
ZSTD_LEVEL: Final = -1  # half the time of the usual 3, and 4 % larger for measured doubles
FOOTER_BODY: Final = 20
_INDEX_HEAD = struct.Struct("<BQHI")
_INDEX = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


class McapWriter:
    """Writes an MCAP file front to back; `write` takes the bytes.

    All checksums are written: of each chunk, of the data section, and of the summary. Nothing is
    written that our reader would refuse by its limits (`service.formats.limits`).
    """

    def __init__(self, write: Callable[[bytes], object]) -> None:
        self._write = write
        self._offset = 0
        self._crc = 0
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._messages: set[str] = set()
        self._fields: list[tuple[NumericField, ...]] = []
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._span: tuple[int, int] | None = None
        self._put_bytes(MCAP_MAGIC)
        self._put_record(Header(profile="", library=LIBRARY))

    def add_metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Add a metadata record."""
        offset = self._offset
        length = self._put_record(Metadata(name, dict(content)))
        self._metadata.append(MetadataIndex(offset, length, name))

    def add_topic(self, path: str, fields: Sequence[str]) -> int:
        """Register a schema and a channel of doubles; return the channel's number."""
        number = len(self._channels) + 1
        message = make_identifiers([path.strip("/").replace("/", "_")])[0].capitalize()
        if message in self._messages:
            message = f"{message}_{number}"
        data = build_schema(message, fields)
        if len(data) > DEFAULT_LIMITS.schema_bytes:
            raise ValueError(
                f"the names of {len(fields)} channels are too long to be stored; shorten them"
            )
        schema = Schema(number, data, "protobuf", f"lagid.{message}")
        channel = Channel(number, path, "protobuf", {}, number)
        for record, encoded in ((schema, self._schemas), (channel, self._channels)):
            encoded.append(_encode_record(record))  # written again in the summary
            self._put_bytes(encoded[-1])
        self._messages.add(message)
        self._fields.append(make_double_fields(tuple(fields)))
        self._counts[number] = 0
        return number

    def add_samples(
        self, channel: int, log_times: Nanoseconds, columns: Sequence[FloatArray]
    ) -> None:
        """Add all samples of a channel, in chunks."""
        fields = self._fields[channel - 1]
        layout = make_record_dtype(fields)
        chunk_samples = min(CHUNK_SAMPLES, max(CHUNK_BYTES // layout.itemsize, 1))
        messages = np.zeros(min(chunk_samples, log_times.size), layout)
        messages["opcode"] = Opcode.MESSAGE
        messages["length"] = layout.itemsize - MESSAGE_HEADER
        messages["channel"] = channel
        for i, field in enumerate(fields):
            messages[f"tag{i}"] = encode_tag_value(field)
        index = np.zeros(messages.size, _INDEX)
        index["offset"] = layout.itemsize * np.arange(messages.size)
        for first in range(0, log_times.size, chunk_samples):
            part = slice(first, min(first + chunk_samples, log_times.size))
            chunk = messages[: part.stop - first]
            chunk["sequence"] = np.arange(part.start, part.stop)
            chunk["log_time"] = chunk["publish_time"] = log_times[part]
            index["log_time"][: chunk.size] = log_times[part]
            for i, values in enumerate(columns):
                chunk[f"value{i}"] = values[part]
            self._put_chunk(channel, chunk, index[: chunk.size])

    def finish_file(self) -> None:
        """Write the end of the data, the summary and the footer."""
        self._put_record(DataEnd(self._crc))
        summary_start, self._crc = self._offset, 0
        offsets = [
            SummaryOffset(Opcode(opcode), start, self._offset - start)
            for opcode, records in self._collect_summary()
            if records and (start := self._offset) >= 0 and self._put_records(records)
        ]
        offsets_start = self._offset
        self._put_records(offsets)
        footer = _encode_record(Footer(summary_start, offsets_start, 0))
        crc = zlib.crc32(footer[:-4], self._crc)
        self._put_bytes(footer[:-4] + crc.to_bytes(4, "little") + MCAP_MAGIC)

    def _collect_summary(self) -> list[tuple[int, Sequence[McapRecord | bytes]]]:
        first, last = self._span or (0, 0)
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_start_time=first,
            message_end_time=last,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.METADATA_INDEX, self._metadata),
        ]

    def _put_chunk(self, channel: int, messages: NDArray[np.void], index: NDArray[np.void]) -> None:
        content = messages.tobytes()
        first, last = (int(messages["log_time"][index_of]) for index_of in (0, -1))
        chunk = Chunk(
            compression="zstd",
            data=self._compressor.compress(content),
            message_end_time=last,
            message_start_time=first,
            uncompressed_crc=zlib.crc32(content),
            uncompressed_size=len(content),
        )
        start = self._offset
        length = self._put_record(chunk)
        index_start = self._offset
        entries = index.tobytes()
        head = _INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel, len(entries))
        self._put_bytes(head + entries)
        self._chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=last,
                message_index_length=self._offset - index_start,
                message_index_offsets={channel: index_start},
                message_start_time=first,
                uncompressed_size=len(content),
            )
        )
        self._counts[channel] += messages.size
        span = self._span or (first, last)
        self._span = min(span[0], first), max(span[1], last)

    def _put_records(self, records: Sequence[McapRecord | bytes]) -> int:
        return sum(self._put_record(record) for record in records)

    def _put_record(self, record: McapRecord | bytes) -> int:
        data = record if isinstance(record, bytes) else _encode_record(record)
        if len(data) > DEFAULT_LIMITS.record_bytes:
            raise ValueError(
                f"a {type(record).__name__} of {len(data)} bytes cannot be stored; the recording "
                "has too many segments or too long names"
            )
        self._put_bytes(data)
        return len(data)

    def _put_bytes(self, data: bytes) -> None:
        self._write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._offset += len(data)


def _encode_record(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
