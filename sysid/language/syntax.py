"""What the parser makes of a text: nodes that still carry names, and the column each came from."""

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

MAX_LENGTH = 4000
"""Characters of one equation."""

MAX_DEPTH = 64
"""Nesting of one equation; long sums and products are folded, so they do not count as deep."""


class TextFault(NamedTuple):
    """One thing wrong with a text.

    Attributes
    ----------
    column : int
        From 1.
    detail : str
        What was wrong, and what would be right.
    """

    column: int
    detail: str


class SyntaxFault(Exception):
    """A text cannot be parsed further. Does not leave this package."""

    def __init__(self, column: int, detail: str) -> None:
        super().__init__(detail)
        self.fault = TextFault(column, detail)


@dataclass(frozen=True, slots=True)
class Literal:
    """A number as written."""

    value: float
    column: int


@dataclass(frozen=True, slots=True)
class Name:
    """A name as written, not yet resolved."""

    name: str
    column: int


@dataclass(frozen=True, slots=True)
class Prefix:
    """``-a`` or ``not a``."""

    operator: str
    operand: "Syntax"
    column: int


@dataclass(frozen=True, slots=True)
class Infix:
    """``a operator b``; the column is the operator's."""

    operator: str
    left: "Syntax"
    right: "Syntax"
    column: int


@dataclass(frozen=True, slots=True)
class Apply:
    """``name(a, b, …)``: a function, or a signal at another time."""

    name: str
    arguments: "tuple[Syntax, ...]"
    column: int


Syntax: TypeAlias = Literal | Name | Prefix | Infix | Apply
