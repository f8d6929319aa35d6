"""Messages of one channel as columns of numbers.

A run of messages that all have the layout of a flat protobuf message with every field written
(as our own files have) is read as one array. All others are decoded one by one: protobuf by its
schema, JSON by its keys.

Protobuf schemas of flat messages of doubles, and the fixed layout of such a message.
"""

import json
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass
from mcap.opcode import Opcode
from numpy.typing import NDArray

MESSAGE_HEADER = 9
"""Opcode and length, which every MCAP record begins with."""

_CACHE_SIZE = 64
"""Names and layouts that are remembered: the files of a sweep's runs have the same ones."""

_WIRE_TYPES = {
    FieldDescriptorProto.TYPE_DOUBLE: (1, "<f8"),
    FieldDescriptorProto.TYPE_FLOAT: (5, "<f4"),
}


class NumericField(NamedTuple):
    """A numeric field of a flat message: name, number, and type on the wire (``<f8``, ``<f4``)."""

    name: str
    number: int
    wire: str = "<f8"


def make_identifiers(names: Iterable[str]) -> tuple[str, ...]:
    """Return names that protobuf allows, all different, as near to `names` as can be."""
    return _make_unique_identifiers(tuple(names))


@lru_cache(maxsize=_CACHE_SIZE)
def _make_unique_identifiers(names: tuple[str, ...]) -> tuple[str, ...]:
    made: list[str] = []
    for name in names:
        plain = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_") or "channel"
        plain = plain if not plain[0].isdigit() else f"c{plain}"
        number, unique = 2, plain
        while unique.lower() in {one.lower() for one in made}:
            number, unique = number + 1, f"{plain}_{number}"
        made.append(unique)
    return tuple(made)


def build_schema(message: str, fields: Sequence[str]) -> bytes:
    """Return the FileDescriptorSet of message ``lagid.<message>`` with one double per field."""
    fields_of = [
        FieldDescriptorProto(
            name=name,
            number=number,
            type=FieldDescriptorProto.TYPE_DOUBLE,
            label=FieldDescriptorProto.LABEL_OPTIONAL,
        )
        for number, name in zip(_iterate_field_numbers(), fields, strict=False)
    ]
    file = FileDescriptorProto(
        name=f"lagid/{message}.proto",
        package="lagid",
        syntax="proto3",
        message_type=[DescriptorProto(name=message, field=fields_of)],
    )
    return bytes(FileDescriptorSet(file=[file]).SerializeToString(deterministic=True))


def _iterate_field_numbers() -> Iterable[int]:
    yield from range(1, 19_000)
    yield from range(20_000, 2**29)  # those between belong to protobuf itself


@lru_cache(maxsize=_CACHE_SIZE)
def make_double_fields(names: tuple[str, ...]) -> tuple[NumericField, ...]:
    """Fields of a message of `build_schema`."""
    return tuple(
        NumericField(name, number)
        for number, name in zip(_iterate_field_numbers(), names, strict=False)
    )


def parse_flat_fields(schema: bytes, message: str) -> tuple[NumericField, ...] | None:
    """Fields of a message that consists of floats only; None if it is of another kind."""
    try:
        files = FileDescriptorSet.FromString(schema).file
    except DecodeError:
        return None
    for file in files:
        for found in file.message_type:
            if f"{file.package}.{found.name}".lstrip(".") == message:
                return _parse_flat_message(found)
    return None


def _parse_flat_message(message: DescriptorProto) -> tuple[NumericField, ...] | None:
    single = all(one.label != FieldDescriptorProto.LABEL_REPEATED for one in message.field)
    if not message.field or not single or not all(f.type in _WIRE_TYPES for f in message.field):
        return None
    ordered = sorted(message.field, key=lambda one: one.number)
    return tuple(NumericField(one.name, one.number, _WIRE_TYPES[one.type][1]) for one in ordered)


@lru_cache(maxsize=_CACHE_SIZE)
def make_record_dtype(fields: tuple[NumericField, ...]) -> np.dtype[np.void]:
    """One MCAP message record whose protobuf content writes every field, zeros too.

    ``tag0, value0, tag1, …`` follow the record's own fields; a tag is 1 to 5 bytes.
    """
    parts: list[tuple[str, str]] = [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_time", "<u8"),
        ("publish_time", "<u8"),
    ]
    for i, field in enumerate(fields):
        length = len(encode_tag(field))
        parts += [(f"tag{i}", "u1" if length == 1 else f"S{length}"), (f"value{i}", field.wire)]
    return np.dtype(parts)


def encode_tag_value(field: NumericField) -> int | bytes:
    """The field's tag as it stands in a `make_record_dtype`: numbers compare faster than texts."""
    tag = encode_tag(field)
    return tag[0] if len(tag) == 1 else tag


def encode_tag(field: NumericField) -> bytes:
    """The field's tag as protobuf writes it: number and wire type as a varint."""
    value = field.number << 3 | (1 if field.wire == "<f8" else 5)
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*encoded, value))


MAX_NESTING: Final = 4
"""Messages inside messages are looked into down to this depth."""

TIME_MESSAGES: Final = ("google.protobuf.Timestamp", "google.protobuf.Duration")
NumbersByName = Mapping[str, float]
MessageDecoder = Callable[[bytes], NumbersByName]


class UnreadableMessages(Exception):
    """Messages of a channel cannot be read; the text says why."""


class MessageSchema(NamedTuple):
    """A schema record."""

    name: str
    encoding: str
    data: bytes


class FlatLayout:
    """A record layout, and what must stand at its fixed places."""

    def __init__(self, channel: int, fields: tuple[NumericField, ...]) -> None:
        self.names = tuple(field.name for field in fields)
        self.dtype = make_record_dtype(fields)
        self._fixed: list[tuple[str, object]] = [
            ("opcode", Opcode.MESSAGE),
            ("length", self.dtype.itemsize - MESSAGE_HEADER),
            ("channel", channel),
            *((f"tag{i}", encode_tag_value(field)) for i, field in enumerate(fields)),
        ]

    def parse_chunk(self, content: bytes) -> NDArray[np.void] | None:
        """All messages of a chunk, if every one has this layout."""
        if not content or len(content) % self.dtype.itemsize:
            return None
        messages = np.frombuffer(content, self.dtype)
        if all(bool(np.all(messages[name] == value)) for name, value in self._fixed):
            return messages
        return None


def find_flat_layout(
    channel: int, encoding: str, schema: MessageSchema | None
) -> FlatLayout | None:
    """Layout of a channel's messages, if its schema is one of plain floats."""
    if encoding != "protobuf" or schema is None or schema.encoding != "protobuf":
        return None
    fields = parse_flat_fields(schema.data, schema.name)
    return FlatLayout(channel, fields) if fields else None


def choose_decoder(encoding: str, schema: MessageSchema | None) -> MessageDecoder:
    """Return what decodes a channel's messages one by one.

    Raises
    ------
    Unreadable
        If messages of that encoding are not read, or the schema is of no use.
    """
    if encoding == "json":
        return _decode_json
    if encoding == "protobuf":
        if schema is None or schema.encoding != "protobuf":
            raise UnreadableMessages("its protobuf messages have no protobuf schema")
        return _make_protobuf_decoder(schema)
    if encoding == "cdr":
        raise UnreadableMessages("its messages are ROS 2 CDR, which is not read: export it as CSV")
    raise UnreadableMessages(
        f"its messages are encoded as {encoding[:40]!r}; need protobuf or json"
    )


def _decode_json(data: bytes) -> NumbersByName:
    try:
        found = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise UnreadableMessages(f"a message is not JSON ({type(error).__name__})") from None
    if not isinstance(found, dict):
        raise UnreadableMessages("a message is not a JSON object")
    return dict(_flatten_numbers(found, "", MAX_NESTING))


def _flatten_numbers(
    found: Mapping[str, object], before: str, depth: int
) -> Iterator[tuple[str, float]]:
    for name, value in found.items():
        if isinstance(value, bool | int | float):
            try:
                yield before + name, float(value)
            except OverflowError:
                raise UnreadableMessages(
                    f"the value of {name!r} is too large for a double"
                ) from None
        elif isinstance(value, dict) and depth > 1:
            yield from _flatten_numbers(value, f"{before}{name}.", depth - 1)


def _make_protobuf_decoder(schema: MessageSchema) -> MessageDecoder:
    try:
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file)
        made = GetMessageClass(pool.FindMessageTypeByName(schema.name))
        getters = dict(_iterate_field_paths(made.DESCRIPTOR, "", (), MAX_NESTING))
    except (DecodeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise UnreadableMessages(f"its schema cannot be used ({type(error).__name__})") from None
    if not getters:
        raise UnreadableMessages("its messages have no field that is one number")

    def decode(data: bytes) -> NumbersByName:
        try:
            message = made.FromString(data)
        except (DecodeError, RecursionError):
            raise UnreadableMessages("a message does not follow its schema") from None
        return {name: _get_number(message, path) for name, path in getters.items()}

    return decode


def _iterate_field_paths(
    message: Descriptor, before: str, path: tuple[str, ...], depth: int
) -> Iterator[tuple[str, tuple[str, ...]]]:
    for field in message.fields:
        if field.is_repeated:
            continue
        here = (*path, field.name)
        if field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
            if depth > 1 and field.message_type.full_name not in TIME_MESSAGES:
                yield from _iterate_field_paths(
                    field.message_type, f"{before}{field.name}.", here, depth - 1
                )
        elif field.cpp_type != FieldDescriptor.CPPTYPE_STRING:
            yield before + field.name, here


def _get_number(message: Message, path: tuple[str, ...]) -> float:
    found: object = message
    for name in path:
        found = getattr(found, name)
    return float(found)  # type: ignore[arg-type]


class MessageColumns:
    """Columns of one channel, as its messages come.

    A name that a message lacks is missing (``nan``) there.
    """

    def __init__(self) -> None:
        self._blocks: list[tuple[NDArray[np.uint64], dict[str, NDArray[np.float64]]]] = []
        self._times = array("Q")
        self._columns: dict[str, array[float]] = {}

    def add_block(self, layout: FlatLayout, messages: NDArray[np.void]) -> None:
        """Add many messages of one layout."""
        self._close_block()
        columns = {
            name: messages[f"value{i}"].astype(np.float64) for i, name in enumerate(layout.names)
        }
        self._blocks.append((messages["log_time"].copy(), columns))

    def add_message(self, log_time: int, numbers: NumbersByName) -> None:
        """Add one message."""
        for name in numbers:
            if name not in self._columns:
                self._columns[name] = array("d", [float("nan")]) * len(self._times)
        self._times.append(log_time)
        for name, column in self._columns.items():
            column.append(numbers.get(name, float("nan")))

    def count_names(self) -> int:
        """Count the names seen since the last block."""
        return len(self._columns)

    def concatenate_blocks(self) -> tuple[NDArray[np.uint64], dict[str, NDArray[np.float64]]]:
        """Return log times and columns of all messages, in the file's order."""
        self._close_block()
        names = list(dict.fromkeys(name for _, columns in self._blocks for name in columns))
        if not names:
            return np.empty(0, np.uint64), {}
        times = np.concatenate([block for block, _ in self._blocks])
        return times, {
            name: np.concatenate(
                [columns.get(name, np.full(block.size, np.nan)) for block, columns in self._blocks]
            )
            for name in names
        }

    def _close_block(self) -> None:
        if self._times:
            columns = {n: np.frombuffer(c, np.float64) for n, c in self._columns.items()}
            self._blocks.append((np.frombuffer(self._times, np.uint64), columns))
            self._times, self._columns = array("Q"), {}
