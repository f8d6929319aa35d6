"""Protobuf schemas of flat messages of doubles, and the fixed layout of such a message."""

import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.message import DecodeError

MESSAGE_HEADER = 9
"""Opcode and length, which every MCAP record begins with."""

_KEPT = 64
"""Names and layouts that are remembered: the files of a sweep's runs have the same ones."""

_WIRE_TYPES = {
    FieldDescriptorProto.TYPE_DOUBLE: (1, "<f8"),
    FieldDescriptorProto.TYPE_FLOAT: (5, "<f4"),
}


class Field(NamedTuple):
    """A numeric field of a flat message: name, number, and type on the wire (``<f8``, ``<f4``)."""

    name: str
    number: int
    wire: str = "<f8"


def identifiers(names: Iterable[str]) -> tuple[str, ...]:
    """Return names that protobuf allows, all different, as near to `names` as can be."""
    return _identifiers(tuple(names))


@lru_cache(maxsize=_KEPT)
def _identifiers(names: tuple[str, ...]) -> tuple[str, ...]:
    made: list[str] = []
    for name in names:
        plain = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_") or "channel"
        plain = plain if not plain[0].isdigit() else f"c{plain}"
        number, unique = 2, plain
        while unique.lower() in {one.lower() for one in made}:
            number, unique = number + 1, f"{plain}_{number}"
        made.append(unique)
    return tuple(made)


def schema_of(message: str, fields: Sequence[str]) -> bytes:
    """Return the FileDescriptorSet of message ``lagid.<message>`` with one double per field."""
    fields_of = [
        FieldDescriptorProto(
            name=name,
            number=number,
            type=FieldDescriptorProto.TYPE_DOUBLE,
            label=FieldDescriptorProto.LABEL_OPTIONAL,
        )
        for number, name in zip(_numbers(), fields, strict=False)
    ]
    file = FileDescriptorProto(
        name=f"lagid/{message}.proto",
        package="lagid",
        syntax="proto3",
        message_type=[DescriptorProto(name=message, field=fields_of)],
    )
    return bytes(FileDescriptorSet(file=[file]).SerializeToString(deterministic=True))


def _numbers() -> Iterable[int]:
    yield from range(1, 19_000)
    yield from range(20_000, 2**29)  # those between belong to protobuf itself


@lru_cache(maxsize=_KEPT)
def double_fields(names: tuple[str, ...]) -> tuple[Field, ...]:
    """Fields of a message of `schema_of`."""
    return tuple(Field(name, number) for number, name in zip(_numbers(), names, strict=False))


def flat_fields(schema: bytes, message: str) -> tuple[Field, ...] | None:
    """Fields of a message that consists of floats only; None if it is of another kind."""
    try:
        files = FileDescriptorSet.FromString(schema).file
    except DecodeError:
        return None
    for file in files:
        for found in file.message_type:
            if f"{file.package}.{found.name}".lstrip(".") == message:
                return _flat(found)
    return None


def _flat(message: DescriptorProto) -> tuple[Field, ...] | None:
    single = all(one.label != FieldDescriptorProto.LABEL_REPEATED for one in message.field)
    if not message.field or not single or not all(f.type in _WIRE_TYPES for f in message.field):
        return None
    ordered = sorted(message.field, key=lambda one: one.number)
    return tuple(Field(one.name, one.number, _WIRE_TYPES[one.type][1]) for one in ordered)


@lru_cache(maxsize=_KEPT)
def record_layout(fields: tuple[Field, ...]) -> np.dtype[np.void]:
    """One MCAP message record whose protobuf content writes every field, zeros too.

    ``tag0, value0, tag1, …`` follow the record's own fields; a tag is 1 to 5 bytes.
    """
    parts: list[tuple[str, str]] = [
        ("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
        ("log_time", "<u8"), ("publish_time", "<u8"),
    ]  # fmt: skip
    for i, field in enumerate(fields):
        length = len(tag_bytes(field))
        parts += [(f"tag{i}", "u1" if length == 1 else f"S{length}"), (f"value{i}", field.wire)]
    return np.dtype(parts)


def tag_value(field: Field) -> int | bytes:
    """The field's tag as it stands in a `record_layout`: numbers compare faster than texts."""
    tag = tag_bytes(field)
    return tag[0] if len(tag) == 1 else tag


def tag_bytes(field: Field) -> bytes:
    """The field's tag as protobuf writes it: number and wire type as a varint."""
    value = field.number << 3 | (1 if field.wire == "<f8" else 5)
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*encoded, value))
