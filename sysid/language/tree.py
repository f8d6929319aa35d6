"""The checked expression tree of the model language: what the grammar makes and the kernels read.

After checking, every name is resolved and every past value is a `PastValue` with its fixed offset
and its unknown lag apart, so that code generation never looks at text.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias


@dataclass(frozen=True, slots=True)
class Number:
    """A literal or a model constant."""

    value: float


@dataclass(frozen=True, slots=True)
class Symbol:
    """A parameter, or one of the reserved quantities.

    ``parameter``: its name; ``time``: ``t``, s from the start of the record; ``index``: ``k``, the
    sample number; ``period``: ``h``, the sampling period in s.
    """

    name: str
    kind: Literal["parameter", "time", "index", "period"]


@dataclass(frozen=True, slots=True)
class PastValue:
    """The value of a state or an input, now or in the past.

    Attributes
    ----------
    name : str
        The signal.
    kind : {"state", "input"}
    offset : int
        Whole samples back (difference form); 0 in the differential form.
    lag : Expression or None
        What is subtracted besides `offset`: in samples in the difference form (``L/h``), in
        seconds in the differential form. Made of parameters, numbers and ``h`` only, never
        negative inside the bounds. None: no unknown lag.
    """

    name: str
    kind: Literal["state", "input"]
    offset: int = 0
    delay: "Expression | None" = None


@dataclass(frozen=True, slots=True)
class Unary:
    """``-a`` or ``not a``."""

    operator: Literal["-", "not"]
    operand: "Expression"


@dataclass(frozen=True, slots=True)
class Binary:
    """An operator of the table (`sysid.language.functions`) between two operands.

    Comparison and logic stand only in the condition of `where`.
    """

    operator: str
    left: "Expression"
    right: "Expression"


@dataclass(frozen=True, slots=True)
class FunctionCall:
    """A function of the table (`sysid.language.functions`) of its arguments."""

    function: str
    arguments: "tuple[Expression, ...]"


Expression: TypeAlias = Number | Symbol | PastValue | Unary | Binary | FunctionCall


def find_children(tree: Expression) -> tuple[Expression, ...]:
    """The nodes right below the root of a tree, in the order of the text; of `PastValue`, its lag."""
    match tree:
        case PastValue(delay=lag):
            return () if lag is None else (lag,)
        case Unary(_, operand):
            return (operand,)
        case Binary(_, left, right):
            return (left, right)
        case FunctionCall(_, arguments):
            return arguments
        case _:
            return ()


def walk(tree: Expression) -> Iterator[Expression]:
    """Every node of a tree, the root first, then its children in the order of the text."""
    yield tree
    for child in find_children(tree):
        yield from walk(child)


def match_plain_state(tree: Expression) -> str | None:
    """Name of the state that an expression is; None where it is anything else."""
    match tree:
        case PastValue(name, "state", 0, None):
            return name
        case _:
            return None
