"""Read all channels of an MCAP file as columns, within limits."""

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import BinaryIO, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from service.formats.limits import UploadLimits
from service.formats.mcap.mcap_messages import (
    FlatLayout,
    MessageColumns,
    MessageDecoder,
    MessageSchema,
    UnreadableMessages,
    choose_decoder,
    find_flat_layout,
    split_stamps,
)
from service.formats.mcap.mcap_records import (
    RECORD_HEAD,
    CutOffFile,
    RawRecord,
    RecordCursor,
    decompress_chunk,
    describe_opcode,
    iterate_records,
)
from service.formats.mcap.mcap_writer import MCAP_MAGIC
from service.formats.mcap.topics import LATEST_NS
from service.formats.read_options import Clock
from sysid.core.errors import Advice, UnreadableFile

_CLOCK_WORDS: Final[Mapping[Clock, str]] = {
    "log": "log time",
    "publish": "publish time",
    "stamp": "stamp in a header, such as header.stamp",
}
_MESSAGE_HEAD: Final = struct.Struct("<HIQQ")


@dataclass(eq=False)
class McapChannel:
    """One MCAP channel: its decoder and its columns. `refusal` says why it cannot be read."""

    topic: str
    layout: FlatLayout | None = None
    decode: MessageDecoder | None = None
    refusal: str = ""
    columns: MessageColumns = field(default_factory=MessageColumns)


@dataclass(eq=False)
class McapContent:
    """Content of a file: channels by number, and metadata records by name.

    `cut` is the error of a file that ends inside a record; None if it is whole.
    """

    channels: dict[int, McapChannel] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    cut: CutOffFile | None = None


def read_content(binary: BinaryIO, size: int, limits: UploadLimits) -> McapContent:
    """Read a file in one pass; of one that is cut off, its whole chunks and messages.

    Raises
    ------
    UnreadableFile
        If the file is damaged, exceeds a limit, or contradicts itself; with the byte. Also if it
        is cut off before its first message.
    """
    reader = _ContentReader(limits)
    try:
        for record in iterate_records(binary, size, limits):
            reader.add_record(record)
    except CutOffFile as cut:
        if not reader.has_messages or _has_end(binary, size):
            raise
        reader.content.cut = cut
    return reader.content


def _has_end(binary: BinaryIO, size: int) -> bool:
    """Whether a file has its end, so that a record past it has a damaged length."""
    binary.seek(size - len(MCAP_MAGIC))
    return binary.read(len(MCAP_MAGIC)) == MCAP_MAGIC


class _ContentReader:
    def __init__(self, limits: UploadLimits) -> None:
        self.content = McapContent()
        self._limits = limits
        self._schemas: dict[int, MessageSchema] = {}
        self._schemas_of: dict[int, tuple[int, str, str]] = {}
        self._messages = self._total = 0

    @property
    def has_messages(self) -> bool:
        """Whether there is a message so far."""
        return self._messages > 0

    def add_record(self, record: RawRecord) -> None:
        """Add a record of the data section."""
        if record.opcode == Opcode.CHUNK:
            content = decompress_chunk(record, self._limits)
            self._total += len(content)
            if self._total > self._limits.total_bytes:
                record.raise_invalid(
                    f"raises the total content to more than {self._limits.total_bytes} bytes"
                )
            self._add_chunk(record, content)
        elif record.opcode == Opcode.METADATA:
            fields = RecordCursor(record)
            name = fields.read_text()
            self.content.metadata[name] = fields.read_mapping()
        else:
            self._add_inner_record(record)

    def _add_inner_record(self, record: RawRecord) -> None:
        """Add a record that may stand inside a chunk or outside."""
        if record.opcode == Opcode.MESSAGE:
            self._add_message(record)
        elif record.opcode == Opcode.SCHEMA:
            self._add_schema(record)
        elif record.opcode == Opcode.CHANNEL:
            self._add_channel(record)

    def _add_chunk(self, chunk: RawRecord, content: bytes) -> None:
        if self._add_uniform_chunk(chunk, content):
            return
        position = 0
        while position < len(content):
            if len(content) - position < RECORD_HEAD.size:
                chunk.raise_invalid(
                    f"ends inside the head of a record, at byte {position} of its content"
                )
            opcode, length = RECORD_HEAD.unpack_from(content, position)
            start, position = position + RECORD_HEAD.size, position + RECORD_HEAD.size + length
            if position > len(content):
                chunk.raise_invalid(
                    f"ends inside the {describe_opcode(opcode)} record at byte "
                    f"{start - RECORD_HEAD.size} of its content"
                )
            self._add_inner_record(RawRecord(opcode, chunk.byte, content[start:position]))

    def _add_uniform_chunk(self, chunk: RawRecord, content: bytes) -> bool:
        """Add a chunk at once, if all its messages have the channel's flat layout."""
        if len(content) < RECORD_HEAD.size + 2 or content[0] != Opcode.MESSAGE:
            return False
        source = self.content.channels.get(
            int.from_bytes(content[RECORD_HEAD.size : RECORD_HEAD.size + 2], "little")
        )
        if source is None or source.layout is None:
            return False
        messages = source.layout.parse_chunk(content)
        if messages is None:
            return False
        self._count_messages(chunk, messages.size)
        if int(messages["log_time"].max()) >= LATEST_NS:
            chunk.raise_invalid("has a message with a time beyond 2⁶³ ns")
        source.columns.add_block(source.layout, messages)
        return True

    def _add_schema(self, record: RawRecord) -> None:
        fields = RecordCursor(record)
        number, name, encoding = fields.read_u16(), fields.read_text(), fields.read_text()
        length = fields.read_u32()
        if length > self._limits.schema_bytes:
            record.raise_invalid(
                f"has {length} bytes; at most {self._limits.schema_bytes} are read"
            )
        schema = MessageSchema(name, encoding, fields.read_bytes(length))
        if number == 0 or self._schemas.setdefault(number, schema) != schema:
            record.raise_invalid(f"uses the number {number}, which is not available")
        if len(self._schemas) > self._limits.channels:
            record.raise_invalid(
                f"exceeds the limit; at most {self._limits.channels} schemas are read"
            )

    def _add_channel(self, record: RawRecord) -> None:
        fields = RecordCursor(record)
        number, schema_number = fields.read_u16(), fields.read_u16()
        topic, encoding = fields.read_text(), fields.read_text()
        fields.read_mapping()
        entry = (schema_number, topic, encoding)
        if self._schemas_of.setdefault(number, entry) != entry:
            record.raise_invalid(f"uses the number {number} again, with another definition")
        if number in self.content.channels:
            return
        if len(self.content.channels) >= self._limits.channels:
            record.raise_invalid(
                f"exceeds the limit; at most {self._limits.channels} channels are read"
            )
        schema = self._schemas.get(schema_number)
        if schema is None and schema_number != 0:
            record.raise_invalid(
                f"refers to schema {schema_number}, which is not defined before it"
            )
        source = self.content.channels[number] = McapChannel(topic)
        try:
            source.decode = choose_decoder(encoding, schema)
            source.layout = find_flat_layout(number, encoding, schema)
        except UnreadableMessages as reason:
            source.refusal = str(reason)

    def _add_message(self, record: RawRecord) -> None:
        if len(record.body) < _MESSAGE_HEAD.size:
            record.raise_invalid(
                f"has {len(record.body)} bytes; its head alone has {_MESSAGE_HEAD.size}"
            )
        number, _, log_time, published = _MESSAGE_HEAD.unpack_from(record.body)
        source = self.content.channels.get(number)
        if source is None:
            record.raise_invalid(f"refers to channel {number}, which is not defined before it")
        if log_time >= LATEST_NS:
            record.raise_invalid("has a time beyond 2⁶³ ns")
        self._count_messages(record, 1)
        if source.decode is None:
            return
        try:
            numbers = source.decode(record.body[_MESSAGE_HEAD.size :])
            source.columns.add_message(log_time, published, numbers)
        except UnreadableMessages as reason:
            record.raise_invalid(f"of topic {source.topic!r} cannot be read: {reason}")
        if source.columns.count_names() > self._limits.channels:
            record.raise_invalid(f"has more than {self._limits.channels} fields")

    def _count_messages(self, record: RawRecord, count: int) -> None:
        self._messages += count
        if self._messages > self._limits.messages:
            record.raise_invalid(
                f"raises the number of messages to more than {self._limits.messages}"
            )


class SortedMessages(NamedTuple):
    """Messages of a channel in order of a clock: times in ns, and columns without their stamps.

    `was_sorted` says that they were in this order. `delays` has the times (ns) by which the log
    comes after the other clocks.
    """

    times: NDArray[np.uint64]
    columns: dict[str, NDArray[np.float64]]
    was_sorted: bool
    delays: dict[Clock, NDArray[np.float64]]


def sort_columns(source: McapChannel, clock: Clock = "log") -> SortedMessages:
    """Return the messages of a channel in the order of a clock.

    Raises
    ------
    UnreadableFile
        If the messages have no such time.
    """
    log_times, published, columns = source.columns.concatenate_blocks()
    stamps, columns = split_stamps(columns)
    clocks: dict[Clock, NDArray[np.uint64]] = {"log": log_times}
    if published.size and published.all():
        clocks["publish"] = published
    if stamps is not None:
        clocks["stamp"] = stamps
    if columns and clock not in clocks:
        raise UnreadableFile(
            f"topic {source.topic!r} has no {_CLOCK_WORDS[clock]}; its clocks are "
            f"{', '.join(clocks)}: ",
            Advice("give one of them as ", "clock"),
        )
    times = clocks.get(clock, log_times)
    delays: dict[Clock, NDArray[np.float64]] = {
        name: (log_times.astype(np.int64) - other.astype(np.int64)).astype(np.float64)
        for name, other in clocks.items()
        if name != "log" and not np.array_equal(other, log_times)
    }
    if np.all(times[1:] >= times[:-1]):
        return SortedMessages(times, columns, True, delays)
    order = np.argsort(times, kind="stable")
    ordered = {name: values[order] for name, values in columns.items()}
    return SortedMessages(times[order], ordered, False, delays)


def build_no_signal_error(content: McapContent) -> UnreadableFile:
    """Return the error of a file without a signal, with a reason for each topic."""
    reasons = [
        f"topic {source.topic!r}: {source.refusal or 'there is no message'}"
        for source in content.channels.values()
    ]
    listed = "; ".join(reasons[:5]) or "it has no channel"
    return UnreadableFile(f"the file holds no signal ({listed})")
