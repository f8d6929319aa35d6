"""Transformations of trees: substitution of nodes, and shifts in time.

Substitution serves ties and feedback. A shift gives the past value of an expression of signals.
"""

from collections.abc import Callable
from dataclasses import replace

from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary


def substitute(
    tree: Expression, replacement: Callable[[Expression], Expression | None]
) -> Expression:
    """Replace each node for which `replacement` returns another one.

    The search starts at the root and does not enter replaced nodes. It enters the delays of past
    values that stay.
    """
    replaced = replacement(tree)
    if replaced is not None:
        return replaced
    match tree:
        case PastValue(delay=delay) if delay is not None:
            return replace(tree, delay=substitute(delay, replacement))
        case Unary(operator, operand):
            return Unary(operator, substitute(operand, replacement))
        case Binary(operator, left, right):
            return Binary(operator, substitute(left, replacement), substitute(right, replacement))
        case FunctionCall(function, arguments):
            return FunctionCall(
                function, tuple(substitute(argument, replacement) for argument in arguments)
            )
        case _:
            return tree


_PERIOD = Symbol("h", "period")


def shift_expression(
    tree: Expression, steps: int, extra_delay: Expression | None, *, counts: bool
) -> Expression:
    """Shift an expression back by whole steps and a delay; `counts`: delays are in samples."""

    def shift_node(node: Expression) -> Expression | None:
        match node:
            case PastValue(name, kind, offset, delay):
                return PastValue(name, kind, offset + steps, add_delays(delay, extra_delay))
            case Symbol(_, "index"):
                return Binary("-", node, back)
            case Symbol(_, "time"):
                return Binary("-", node, Binary("*", back, _PERIOD) if counts else back)
            case _:
                return None

    back = Binary("+", Number(float(steps)), extra_delay or Number(0.0))
    return tree if steps == 0 and extra_delay is None else substitute(tree, shift_node)


def add_delays(delay: Expression | None, other: Expression | None) -> Expression | None:
    """Add two delays; None is no delay."""
    if delay is None or other is None:
        return other if delay is None else delay
    return Binary("+", delay, other)
