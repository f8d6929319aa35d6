"""Expression tree of the model language, from the checker to the kernels.

Every name is resolved. Every past value is a `PastValue` with a fixed offset and an unknown
delay, so that code generation never reads text.
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
    delay : Expression or None
        Delay in addition to `offset`: in samples in the difference form (``L/h``), in seconds in
        the differential form. It contains only parameters, numbers and ``h``, and is never
        negative inside the bounds. The delay of an input may also contain present inputs; then
        the record bounds it. None: no unknown delay.
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

    Comparison and logic occur only in the condition of `where`.
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
    """Return the children of a node, in the order of the text; of a `PastValue`, its delay."""
    match tree:
        case PastValue(delay=delay):
            return () if delay is None else (delay,)
        case Unary(_, operand):
            return (operand,)
        case Binary(_, left, right):
            return (left, right)
        case FunctionCall(_, arguments):
            return arguments
        case _:
            return ()


def walk(tree: Expression) -> Iterator[Expression]:
    """Iterate over the nodes of a tree: the root first, then its children in order."""
    yield tree
    for child in find_children(tree):
        yield from walk(child)


def measure_depth(tree: Expression) -> int:
    """Measure the depth of a tree; a leaf has depth 1."""
    return 1 + max(map(measure_depth, find_children(tree)), default=0)


def match_plain_state(tree: Expression) -> str | None:
    """Return the name of the state that an expression is; None for any other expression."""
    match tree:
        case PastValue(name, "state", 0, None):
            return name
        case _:
            return None
