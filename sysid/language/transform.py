"""Trees as they were some time ago: what a signal made of others is worth in the past.

Trees with parts replaced: how a parameter is tied to others, or an input fed back.
"""

from collections.abc import Callable
from dataclasses import replace

from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary


def substitute(
    tree: Expression, replacement: Callable[[Expression], Expression | None]
) -> Expression:
    """The tree with each node for which `replacement` gives another one replaced by it.

    Nodes are asked from the root on; below one that was replaced nothing is asked. A past value
    that stays is searched too: its lag may name what is replaced.
    """
    found = replacement(tree)
    if found is not None:
        return found
    match tree:
        case PastValue(delay=lag) if lag is not None:
            return replace(tree, delay=substitute(lag, replacement))
        case Unary(operator, operand):
            return Unary(operator, substitute(operand, replacement))
        case Binary(operator, left, right):
            return Binary(operator, substitute(left, replacement), substitute(right, replacement))
        case FunctionCall(function, arguments):
            return FunctionCall(function, tuple(substitute(one, replacement) for one in arguments))
        case _:
            return tree


_PERIOD = Symbol("h", "period")


def shift_expression(
    tree: Expression, steps: int, lag: Expression | None, *, counts: bool
) -> Expression:
    """An expression as it was some whole steps and a lag ago; `counts`: lags are in samples."""

    def earlier(node: Expression) -> Expression | None:
        match node:
            case PastValue(name, kind, offset, own):
                return PastValue(name, kind, offset + steps, add_delays(own, lag))
            case Symbol(_, "index"):
                return Binary("-", node, back)
            case Symbol(_, "time"):
                return Binary("-", node, Binary("*", back, _PERIOD) if counts else back)
            case _:
                return None

    back = Binary("+", Number(float(steps)), lag or Number(0.0))
    return tree if steps == 0 and lag is None else substitute(tree, earlier)


def add_delays(lag: Expression | None, other: Expression | None) -> Expression | None:
    """Two lags, one after the other."""
    if lag is None or other is None:
        return other if lag is None else lag
    return Binary("+", lag, other)
