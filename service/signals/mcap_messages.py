"""Messages of one channel as columns of numbers.

A run of messages that all have the layout of a flat protobuf message with every field written
(as our own files have) is read as one array. All others are decoded one by one: protobuf by its
schema, JSON by its keys.
"""

import json
from array import array
from collections.abc import Callable, Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass
from mcap.opcode import Opcode
from numpy.typing import NDArray

from service.signals.protobuf import MESSAGE_HEADER, Field, flat_fields, record_layout, tag_value

DEEPEST: Final = 4
"""Messages inside messages are looked into down to this depth."""

CLOCKS: Final = ("google.protobuf.Timestamp", "google.protobuf.Duration")
Numbers = Mapping[str, float]
Decoder = Callable[[bytes], Numbers]


class Unreadable(Exception):
    """Messages of a channel cannot be read; the text says why."""


class Schema(NamedTuple):
    """A schema record."""

    name: str
    encoding: str
    data: bytes


class FlatLayout:
    """A record layout, and what must stand at its fixed places."""

    def __init__(self, channel: int, fields: tuple[Field, ...]) -> None:
        self.names = tuple(field.name for field in fields)
        self.dtype = record_layout(fields)
        self._fixed: list[tuple[str, object]] = [
            ("opcode", Opcode.MESSAGE),
            ("length", self.dtype.itemsize - MESSAGE_HEADER),
            ("channel", channel),
            *((f"tag{i}", tag_value(field)) for i, field in enumerate(fields)),
        ]

    def read(self, content: bytes) -> NDArray[np.void] | None:
        """All messages of a chunk, if every one has this layout."""
        if not content or len(content) % self.dtype.itemsize:
            return None
        messages = np.frombuffer(content, self.dtype)
        if all(bool(np.all(messages[name] == value)) for name, value in self._fixed):
            return messages
        return None


def flat_layout(channel: int, encoding: str, schema: Schema | None) -> FlatLayout | None:
    """Layout of a channel's messages, if its schema is one of plain floats."""
    if encoding != "protobuf" or schema is None or schema.encoding != "protobuf":
        return None
    fields = flat_fields(schema.data, schema.name)
    return FlatLayout(channel, fields) if fields else None


def decoder_for(encoding: str, schema: Schema | None) -> Decoder:
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
            raise Unreadable("its protobuf messages have no protobuf schema")
        return _protobuf_decoder(schema)
    if encoding == "cdr":
        raise Unreadable("its messages are ROS 2 CDR, which is not read: export it as CSV")
    raise Unreadable(f"its messages are encoded as {encoding[:40]!r}; need protobuf or json")


def _decode_json(data: bytes) -> Numbers:
    try:
        found = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise Unreadable(f"a message is not JSON ({type(error).__name__})") from None
    if not isinstance(found, dict):
        raise Unreadable("a message is not a JSON object")
    return dict(_numbers(found, "", DEEPEST))


def _numbers(found: Mapping[str, object], before: str, depth: int) -> Iterator[tuple[str, float]]:
    for name, value in found.items():
        if isinstance(value, bool | int | float):
            try:
                yield before + name, float(value)
            except OverflowError:
                raise Unreadable(f"the value of {name!r} is too large for a double") from None
        elif isinstance(value, dict) and depth > 1:
            yield from _numbers(value, f"{before}{name}.", depth - 1)


def _protobuf_decoder(schema: Schema) -> Decoder:
    try:
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file)
        made = GetMessageClass(pool.FindMessageTypeByName(schema.name))
        getters = dict(_getters(made.DESCRIPTOR, "", (), DEEPEST))
    except (DecodeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise Unreadable(f"its schema cannot be used ({type(error).__name__})") from None
    if not getters:
        raise Unreadable("its messages have no field that is one number")

    def decode(data: bytes) -> Numbers:
        try:
            message = made.FromString(data)
        except (DecodeError, RecursionError):
            raise Unreadable("a message does not follow its schema") from None
        return {name: _value(message, path) for name, path in getters.items()}

    return decode


def _getters(
    message: Descriptor, before: str, path: tuple[str, ...], depth: int
) -> Iterator[tuple[str, tuple[str, ...]]]:
    for field in message.fields:
        if field.is_repeated:
            continue
        here = (*path, field.name)
        if field.cpp_type == FieldDescriptor.CPPTYPE_MESSAGE:
            if depth > 1 and field.message_type.full_name not in CLOCKS:
                yield from _getters(field.message_type, f"{before}{field.name}.", here, depth - 1)
        elif field.cpp_type != FieldDescriptor.CPPTYPE_STRING:
            yield before + field.name, here


def _value(message: Message, path: tuple[str, ...]) -> float:
    found: object = message
    for name in path:
        found = getattr(found, name)
    return float(found)  # type: ignore[arg-type]


class Series:
    """Columns of one channel, as its messages come.

    A name that a message lacks is missing (``nan``) there.
    """

    def __init__(self) -> None:
        self._blocks: list[tuple[NDArray[np.uint64], dict[str, NDArray[np.float64]]]] = []
        self._times = array("Q")
        self._columns: dict[str, array[float]] = {}

    def add_block(self, layout: FlatLayout, messages: NDArray[np.void]) -> None:
        """Add many messages of one layout."""
        self._close()
        columns = {
            name: messages[f"value{i}"].astype(np.float64) for i, name in enumerate(layout.names)
        }
        self._blocks.append((messages["log_time"].copy(), columns))

    def add(self, log_time: int, numbers: Numbers) -> None:
        """Add one message."""
        for name in numbers:
            if name not in self._columns:
                self._columns[name] = array("d", [float("nan")]) * len(self._times)
        self._times.append(log_time)
        for name, column in self._columns.items():
            column.append(numbers.get(name, float("nan")))

    def names(self) -> int:
        """Count the names seen since the last block."""
        return len(self._columns)

    def joined(self) -> tuple[NDArray[np.uint64], dict[str, NDArray[np.float64]]]:
        """Return log times and columns of all messages, in the file's order."""
        self._close()
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

    def _close(self) -> None:
        if self._times:
            columns = {n: np.frombuffer(c, np.float64) for n, c in self._columns.items()}
            self._blocks.append((np.frombuffer(self._times, np.uint64), columns))
            self._times, self._columns = array("Q"), {}
