"""Trees with parts replaced: how a parameter is tied to others, or an input fed back."""

from collections.abc import Callable
from dataclasses import replace

from sysid.language.tree import Binary, Call, Expression, Past, Unary


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
        case Past(lag=lag) if lag is not None:
            return replace(tree, lag=substitute(lag, replacement))
        case Unary(operator, operand):
            return Unary(operator, substitute(operand, replacement))
        case Binary(operator, left, right):
            return Binary(operator, substitute(left, replacement), substitute(right, replacement))
        case Call(function, arguments):
            return Call(function, tuple(substitute(one, replacement) for one in arguments))
        case _:
            return tree
