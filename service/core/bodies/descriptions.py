"""What the docstring of a dataclass of the core says of its fields, for wire types.

A field is described once, in the section *Attributes* of its class (numpydoc). Its wire type has
the same sentence, as other wire types write theirs: in one line, without capital and full stop.
"""

import inspect
import re
import sys
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

_SECTION = re.compile(r"^Attributes\n-{10}\n(.*?)(?=\n\n\w+\n-{3,}\n|\Z)", re.S | re.M)
_ENTRY = re.compile(r"^(\w+) : (.*)\n((?:^    .*\n?)+)", re.M)
_SHAPE = re.compile(r"shape \((.*?)\)")


class Description(NamedTuple):
    """What a docstring says of a field: its meaning, and the axes of an array."""

    text: str | None
    axes: int


_UNDESCRIBED = Description(None, 1)
"""Of every field, if Python was started with ``-OO`` and keeps no docstrings."""


@cache
def describe_fields(kind: type) -> Mapping[str, Description]:
    """Read what the docstring of a class, or of its bases, says of each field."""
    described: dict[str, Description] = {}
    for base in reversed(kind.__mro__):
        section = _SECTION.search(inspect.cleandoc(base.__dict__.get("__doc__") or ""))
        for name, type_text, text in _ENTRY.findall(section[1] + "\n" if section else ""):
            shape = _SHAPE.search(type_text)
            axes = len([axis for axis in shape[1].split(",") if axis.strip()]) if shape else 0
            described[name] = Description(_write_sentence(text), axes)
    return described


def describe_field(kind: type, name: str) -> Description:
    """Read what the docstring of a class says of one field.

    Raises
    ------
    KeyError
        If it says nothing.
    """
    return _UNDESCRIBED if sys.flags.optimize > 1 else describe_fields(kind)[name]


def _write_sentence(text: str) -> str:
    line = " ".join(text.split()).removesuffix(".").replace("``", "`")
    line = re.sub(r"\bNone\b", "null", line)
    return line if line[:2].isupper() or line[1:2] == " " else line[:1].lower() + line[1:]
