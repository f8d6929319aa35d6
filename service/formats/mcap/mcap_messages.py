"""Messages of one channel as columns of numbers.

Our files have flat protobuf messages of doubles with every field written, so all have the same
layout. A sequence of such messages is read as one array. Other messages are decoded one by one:
protobuf by its schema, JSON by its keys.
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
"""Size of opcode and length, with which every MCAP record begins."""

_CACHE_SIZE = 64
"""Cached names and layouts: the files of the runs of a sweep share them."""

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
    """Return distinct names that protobuf allows, as similar to `names` as possible."""
    return _make_unique_identifiers(tuple(names))


@lru_cache(maxsize=_CACHE_SIZE)
def _make_unique_identifiers(names: tuple[str, ...]) -> tuple[str, ...]:
    identifiers: list[str] = []
    for name in names:
        plain = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_") or "channel"
        plain = plain if not plain[0].isdigit() else f"c{plain}"
        number, unique = 2, plain
        while unique.lower() in {identifier.lower() for identifier in identifiers}:
            number, unique = number + 1, f"{plain}_{number}"
        identifiers.append(unique)
    return tuple(identifiers)


def build_schema(message: str, fields: Sequence[str]) -> bytes:
    """Return the FileDescriptorSet of message ``lagid.<message>`` with one double per field."""
    descriptors = [
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
        message_type=[DescriptorProto(name=message, field=descriptors)],
    )
    return bytes(FileDescriptorSet(file=[file]).SerializeToString(deterministic=True))


def _iterate_field_numbers() -> Iterable[int]:
    yield from range(1, 19_000)
    yield from range(20_000, 2**29)  # the numbers between are reserved by protobuf


@lru_cache(maxsize=_CACHE_SIZE)
def make_double_fields(names: tuple[str, ...]) -> tuple[NumericField, ...]:
    """Return the fields of a message of `build_schema`."""
    return tuple(
        NumericField(name, number)
        for number, name in zip(_iterate_field_numbers(), names, strict=False)
    )


def parse_flat_fields(schema: bytes, message: str) -> tuple[NumericField, ...] | None:
    """Return the fields of a message that consists of floats only; else None."""
    try:
        files = FileDescriptorSet.FromString(schema).file
    except DecodeError:
        return None
    for file in files:
        for message_type in file.message_type:
            if f"{file.package}.{message_type.name}".lstrip(".") == message:
                return _parse_flat_message(message_type)
    return None


def _parse_flat_message(message: DescriptorProto) -> tuple[NumericField, ...] | None:
    single = all(field.label != FieldDescriptorProto.LABEL_REPEATED for field in message.field)
    if not message.field or not single or not all(f.type in _WIRE_TYPES for f in message.field):
        return None
    ordered = sorted(message.field, key=lambda field: field.number)
    return tuple(
        NumericField(field.name, field.number, _WIRE_TYPES[field.type][1]) for field in ordered
    )


@lru_cache(maxsize=_CACHE_SIZE)
def make_record_dtype(fields: tuple[NumericField, ...]) -> np.dtype[np.void]:
    """Return the dtype of a message record whose protobuf content writes every field, zeros too.

    After the fields of the record follow ``tag0, value0, tag1, …``; a tag has 1 to 5 bytes.
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
    """Encode a tag for `make_record_dtype`, as a number if possible: numbers compare faster."""
    tag = encode_tag(field)
    return tag[0] if len(tag) == 1 else tag


def encode_tag(field: NumericField) -> bytes:
    """Encode a tag as protobuf writes it: field number and wire type as a varint."""
    value = field.number << 3 | (1 if field.wire == "<f8" else 5)
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*encoded, value))


MAX_NESTING: Final = 4
"""Depth to which nested messages are read."""

_STAMP_SECONDS: Final = re.compile(r"(?P<name>.+)\.(?:sec|secs|seconds)")
_STAMP_PARTS: Final = ("nanosec", "nsec", "nsecs", "nanos", "nanoseconds")
TIME_MESSAGES: Final = ("google.protobuf.Duration",)
NumbersByName = Mapping[str, float]
MessageDecoder = Callable[[bytes], NumbersByName]


class UnreadableMessages(Exception):
    """The messages of a channel cannot be read; the text says why."""


class MessageSchema(NamedTuple):
    """A schema record."""

    name: str
    encoding: str
    data: bytes


class FlatLayout:
    """A record layout, and the constants at its fixed positions."""

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
        """Return all messages of a chunk; None unless every one has this layout."""
        if not content or len(content) % self.dtype.itemsize:
            return None
        messages = np.frombuffer(content, self.dtype)
        if all(bool(np.all(messages[name] == value)) for name, value in self._fixed):
            return messages
        return None


def find_flat_layout(
    channel: int, encoding: str, schema: MessageSchema | None
) -> FlatLayout | None:
    """Return the layout of a channel's messages if its schema has plain floats only; else None."""
    if encoding != "protobuf" or schema is None or schema.encoding != "protobuf":
        return None
    fields = parse_flat_fields(schema.data, schema.name)
    return FlatLayout(channel, fields) if fields else None


def choose_decoder(encoding: str, schema: MessageSchema | None) -> MessageDecoder:
    """Return the decoder of a channel's messages.

    Raises
    ------
    UnreadableMessages
        If the encoding is not supported, or the schema is unusable.
    """
    if encoding == "json":
        return _decode_json
    if encoding == "protobuf":
        if schema is None or schema.encoding != "protobuf":
            raise UnreadableMessages("its protobuf messages have no protobuf schema")
        return _make_protobuf_decoder(schema)
    if encoding == "cdr":
        raise UnreadableMessages(
            "its messages are ROS 2 CDR, which is not supported; export them as CSV"
        )
    raise UnreadableMessages(
        f"its messages are encoded as {encoding[:40]!r}; need protobuf or json"
    )


def _decode_json(data: bytes) -> NumbersByName:
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise UnreadableMessages(f"a message is not JSON ({type(error).__name__})") from None
    if not isinstance(document, dict):
        raise UnreadableMessages("a message is not a JSON object")
    return dict(_flatten_numbers(document, "", MAX_NESTING))


def _flatten_numbers(
    document: Mapping[str, object], prefix: str, depth: int
) -> Iterator[tuple[str, float]]:
    for name, value in document.items():
        if isinstance(value, bool | int | float):
            try:
                yield prefix + name, float(value)
            except OverflowError:
                raise UnreadableMessages(
                    f"the value of {name!r} is too large for a double"
                ) from None
        elif isinstance(value, dict) and depth > 1:
            yield from _flatten_numbers(value, f"{prefix}{name}.", depth - 1)


def _make_protobuf_decoder(schema: MessageSchema) -> MessageDecoder:
    try:
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file)
        message_class = GetMessageClass(pool.FindMessageTypeByName(schema.name))
        getters = dict(_iterate_field_paths(message_class.DESCRIPTOR, "", (), MAX_NESTING))
    except (DecodeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise UnreadableMessages(f"its schema cannot be used ({type(error).__name__})") from None
    if not getters:
        raise UnreadableMessages("its messages have no field that is one number")

    def decode(data: bytes) -> NumbersByName:
        try:
            message = message_class.FromString(data)
        except (DecodeError, RecursionError):
            raise UnreadableMessages("a message does not follow its schema") from None
        return {name: _get_number(message, path) for name, path in getters.items()}

    return decode


def _iterate_field_paths(
    message: Descriptor, prefix: str, path: tuple[str, ...], depth: int
) -> Iterator[tuple[str, tuple[str, ...]]]:
    for field in message.fields:
        if field.is_repeated:
            continue
        field_path = (*path, field.name)
        if field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
            if depth > 1 and field.message_type.full_name not in TIME_MESSAGES:
                yield from _iterate_field_paths(
                    field.message_type, f"{prefix}{field.name}.", field_path, depth - 1
                )
        elif field.cpp_type != FieldDescriptor.CPPTYPE_STRING:
            yield prefix + field.name, field_path


def _get_number(message: Message, path: tuple[str, ...]) -> float:
    value: object = message
    for name in path:
        value = getattr(value, name)
    return float(value)  # type: ignore[arg-type]


class MessageBlock(NamedTuple):
    """Log times and publish times (ns) of messages, and their numbers."""

    times: NDArray[np.uint64]
    published: NDArray[np.uint64]
    columns: dict[str, NDArray[np.float64]]


def split_stamps(
    columns: Mapping[str, NDArray[np.float64]],
) -> tuple[NDArray[np.uint64] | None, dict[str, NDArray[np.float64]]]:
    """Split the stamps of messages (ns) off their signals; None if not all have one.

    A stamp has seconds and nanoseconds, below a name such as ``header.stamp`` or ``timestamp``.
    The first one is taken, and none of its parts is a signal.
    """
    pairs = []
    for name in columns:
        if match := _STAMP_SECONDS.fullmatch(name):
            parts = (f"{match['name']}.{part}" for part in _STAMP_PARTS)
            pairs += [(name, part) for part in parts if part in columns]
    used = {name for pair in pairs for name in pair}
    signals = {name: values for name, values in columns.items() if name not in used}
    if not pairs:
        return None, signals
    seconds, rest = (columns[name] for name in pairs[0])
    if not (np.isfinite(seconds) & np.isfinite(rest)).all() or np.any(seconds <= 0):
        return None, signals
    return seconds.astype(np.uint64) * np.uint64(10**9) + rest.astype(np.uint64), signals


class MessageColumns:
    """Columns of one channel, collected from its messages.

    A name that a message lacks is missing (``nan``) there.
    """

    def __init__(self) -> None:
        self._blocks: list[MessageBlock] = []
        self._times, self._published = array("Q"), array("Q")
        self._columns: dict[str, array[float]] = {}

    def add_block(self, layout: FlatLayout, messages: NDArray[np.void]) -> None:
        """Add many messages of one layout."""
        self._close_block()
        columns = {
            name: messages[f"value{i}"].astype(np.float64) for i, name in enumerate(layout.names)
        }
        times, published = messages["log_time"].copy(), messages["publish_time"].copy()
        self._blocks.append(MessageBlock(times, published, columns))

    def add_message(self, log_time: int, published: int, numbers: NumbersByName) -> None:
        """Add one message."""
        for name in numbers:
            if name not in self._columns:
                self._columns[name] = array("d", [float("nan")]) * len(self._times)
        self._times.append(log_time)
        self._published.append(published)
        for name, column in self._columns.items():
            column.append(numbers.get(name, float("nan")))

    def count_names(self) -> int:
        """Count the names seen since the last block."""
        return len(self._columns)

    def concatenate_blocks(self) -> "MessageBlock":
        """Return log times, publish times and columns of all messages, in the order of the file."""
        self._close_block()
        names = list(dict.fromkeys(name for block in self._blocks for name in block.columns))
        if not names:
            return MessageBlock(np.empty(0, np.uint64), np.empty(0, np.uint64), {})
        columns = {
            name: np.concatenate(
                [one.columns.get(name, np.full(one.times.size, np.nan)) for one in self._blocks]
            )
            for name in names
        }
        times = np.concatenate([block.times for block in self._blocks])
        return MessageBlock(
            times, np.concatenate([block.published for block in self._blocks]), columns
        )

    def _close_block(self) -> None:
        if self._times:
            columns = {n: np.frombuffer(c, np.float64) for n, c in self._columns.items()}
            times = np.frombuffer(self._times, np.uint64)
            published = np.frombuffer(self._published, np.uint64)
            self._blocks.append(MessageBlock(times, published, columns))
            self._times, self._published, self._columns = array("Q"), array("Q"), {}
