"""All channels of an MCAP file as columns, within limits."""

import struct
from dataclasses import dataclass, field
from typing import BinaryIO, Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from service.formats.errors import InvalidUpload
from service.formats.limits import Limits
from service.formats.mcap_messages import (
    Decoder,
    FlatLayout,
    Schema,
    Series,
    Unreadable,
    decoder_for,
    flat_layout,
)
from service.formats.mcap_records import HEAD, Cursor, Located, name_of, open_chunk, walk
from service.formats.topics import LATEST_NS

_MESSAGE: Final = struct.Struct("<HIQQ")


@dataclass(eq=False)
class Source:
    """One MCAP channel: how it is read, and what has been read. `refused` says why it is not."""

    topic: str
    layout: FlatLayout | None = None
    decode: Decoder | None = None
    refused: str = ""
    series: Series = field(default_factory=Series)


@dataclass(eq=False)
class Content:
    """What a file holds: sources by channel number, and its metadata records by name."""

    sources: dict[int, Source] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)


def read_content(binary: BinaryIO, size: int, limits: Limits) -> Content:
    """Read a whole file in one pass.

    Raises
    ------
    InvalidUpload
        With the byte, if the file is damaged, goes beyond a limit, or contradicts itself.
    """
    reader = _Reader(limits)
    for record in walk(binary, size, limits):
        reader.take(record)
    return reader.content


class _Reader:
    def __init__(self, limits: Limits) -> None:
        self.content = Content()
        self._limits = limits
        self._schemas: dict[int, Schema] = {}
        self._schemas_of: dict[int, tuple[int, str, str]] = {}
        self._messages = self._total = 0

    def take(self, record: Located) -> None:
        """Take a record of the data section."""
        if record.opcode == Opcode.CHUNK:
            content = open_chunk(record, self._limits)
            self._total += len(content)
            if self._total > self._limits.total_bytes:
                record.fail(f"brings the content to more than {self._limits.total_bytes} bytes")
            self._chunk(record, content)
        elif record.opcode == Opcode.METADATA:
            fields = Cursor(record)
            name = fields.text()
            self.content.metadata[name] = fields.mapping()
        else:
            self._inner(record)

    def _inner(self, record: Located) -> None:
        """Take a record that may stand in a chunk as well as outside."""
        if record.opcode == Opcode.MESSAGE:
            self._message(record)
        elif record.opcode == Opcode.SCHEMA:
            self._schema(record)
        elif record.opcode == Opcode.CHANNEL:
            self._channel(record)

    def _chunk(self, chunk: Located, content: bytes) -> None:
        if self._uniform(chunk, content):
            return
        at = 0
        while at < len(content):
            if len(content) - at < HEAD.size:
                chunk.fail(f"ends inside the head of a record, at byte {at} of its content")
            opcode, length = HEAD.unpack_from(content, at)
            start, at = at + HEAD.size, at + HEAD.size + length
            if at > len(content):
                chunk.fail(
                    f"ends inside the {name_of(opcode)} record at byte {start - HEAD.size} of its "
                    "content"
                )
            self._inner(Located(opcode, chunk.byte, content[start:at]))

    def _uniform(self, chunk: Located, content: bytes) -> bool:
        """Take a chunk of messages that all have their channel's flat layout, at once."""
        if len(content) < HEAD.size + 2 or content[0] != Opcode.MESSAGE:
            return False
        source = self.content.sources.get(
            int.from_bytes(content[HEAD.size : HEAD.size + 2], "little")
        )
        if source is None or source.layout is None:
            return False
        messages = source.layout.read(content)
        if messages is None:
            return False
        self._count(chunk, messages.size)
        if int(messages["log_time"].max()) >= LATEST_NS:
            chunk.fail("has a message with a time beyond 2⁶³ ns")
        source.series.add_block(source.layout, messages)
        return True

    def _schema(self, record: Located) -> None:
        fields = Cursor(record)
        number, name, encoding = fields.u16(), fields.text(), fields.text()
        length = fields.u32()
        if length > self._limits.schema_bytes:
            record.fail(f"has {length} bytes; at most {self._limits.schema_bytes} are read")
        schema = Schema(name, encoding, fields.blob(length))
        if number == 0 or self._schemas.setdefault(number, schema) != schema:
            record.fail(f"uses the number {number}, which is not free")
        if len(self._schemas) > self._limits.channels:
            record.fail(f"is one too many; at most {self._limits.channels} are read")

    def _channel(self, record: Located) -> None:
        fields = Cursor(record)
        number, schema_number = fields.u16(), fields.u16()
        topic, encoding = fields.text(), fields.text()
        fields.mapping()
        entry = (schema_number, topic, encoding)
        if self._schemas_of.setdefault(number, entry) != entry:
            record.fail(f"uses the number {number} a second time, for something else")
        if number in self.content.sources:
            return
        if len(self.content.sources) >= self._limits.channels:
            record.fail(f"is one too many; at most {self._limits.channels} are read")
        schema = self._schemas.get(schema_number)
        if schema is None and schema_number != 0:
            record.fail(f"names schema {schema_number}, which does not come before it")
        source = self.content.sources[number] = Source(topic)
        try:
            source.decode = decoder_for(encoding, schema)
            source.layout = flat_layout(number, encoding, schema)
        except Unreadable as reason:
            source.refused = str(reason)

    def _message(self, record: Located) -> None:
        if len(record.body) < _MESSAGE.size:
            record.fail(f"has {len(record.body)} bytes; its head alone has {_MESSAGE.size}")
        number, _, log_time, _ = _MESSAGE.unpack_from(record.body)
        source = self.content.sources.get(number)
        if source is None:
            record.fail(f"names channel {number}, which does not come before it")
        if log_time >= LATEST_NS:
            record.fail("has a time beyond 2⁶³ ns")
        self._count(record, 1)
        if source.decode is None:
            return
        try:
            source.series.add(log_time, source.decode(record.body[_MESSAGE.size :]))
        except Unreadable as reason:
            record.fail(f"of topic {source.topic!r} cannot be read: {reason}")
        if source.series.names() > self._limits.channels:
            record.fail(f"has more than {self._limits.channels} fields")

    def _count(self, record: Located, more: int) -> None:
        self._messages += more
        if self._messages > self._limits.messages:
            record.fail(f"brings the messages to more than {self._limits.messages}")


def sorted_columns(
    source: Source,
) -> tuple[NDArray[np.uint64], dict[str, NDArray[np.float64]], bool]:
    """Log times, columns, and whether they had to be sorted by time."""
    times, columns = source.series.joined()
    if np.all(times[1:] >= times[:-1]):
        return times, columns, False
    order = np.argsort(times, kind="stable")
    return times[order], {name: values[order] for name, values in columns.items()}, True


def no_signals(content: Content) -> InvalidUpload:
    """Return the error of a file without a signal: for each topic, why."""
    reasons = [
        f"topic {source.topic!r}: {source.refused or 'there is no message'}"
        for source in content.sources.values()
    ]
    listed = "; ".join(reasons[:5]) or "it has no channel"
    return InvalidUpload(f"the file holds no signal ({listed})")
