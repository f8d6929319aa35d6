"""Switches in time: where an expression of ``t`` and parameters alone jumps or bends.

``where(t > tlag, …)`` jumps at tlag, ``max(t - tlag, 0)`` bends there. An integration step across
such a time is of order one, and its result does not move with tlag, or jumps. So a step ends just
before a switch, and the next begins just behind it.

A switch is told by its *side*, an expression that is a whole number and changes at the switch only.
"""

from collections.abc import Iterable, Iterator
from itertools import combinations

from sysid.language.delays import collect_past_values, mentions_time
from sysid.language.table_functions import TABLE_FUNCTIONS, split_table
from sysid.language.tree import Binary, Expression, FunctionCall, Number, walk

_ORDERINGS = ("<", "<=", ">", ">=")
_ZERO, _HALF, _ONE = Number(0.0), Number(0.5), Number(1.0)


def list_sides(trees: Iterable[Expression]) -> tuple[Expression, ...]:
    """List the sides of all switches in time of some expressions, each once.

    A switch that a signal has a part in, such as ``max(x, t)``, is none in time. Equality holds at
    single times, and has no sides.
    """
    found = [side for tree in trees for node in walk(tree) for side in _iterate_sides(node)]
    return tuple(side for side in dict.fromkeys(found) if _depends_on_time_alone(side))


def _depends_on_time_alone(tree: Expression) -> bool:
    return mentions_time(tree) and not collect_past_values(tree)


def _iterate_sides(node: Expression) -> Iterator[Expression]:
    """Iterate over the sides of a node, also of one that depends on signals."""
    match node:
        case Binary(operator, left, right) if operator in _ORDERINGS:
            yield _tell(operator, left, right)
        case FunctionCall("sign", (argument,)):
            yield _tell(">", argument, _ZERO)
            yield _tell("<", argument, _ZERO)
        case FunctionCall("abs", (argument,)):
            yield _tell(">", argument, _ZERO)
        case FunctionCall("min" | "max", arguments):
            for first, second in combinations(arguments, 2):
                yield _tell(">", first, second)
        case FunctionCall("clip", (argument, lower, upper)):
            yield _tell(">", argument, lower)
            yield _tell(">", argument, upper)
        case FunctionCall("floor"):
            yield node
        case FunctionCall("mod", (argument, divisor)):
            # Rounded, so that it changes exactly where the remainder does.
            periods = Binary("/", Binary("-", argument, node), divisor)
            yield FunctionCall("floor", (Binary("+", periods, _HALF),))
        case FunctionCall(function) if function in TABLE_FUNCTIONS:
            table = split_table(node)
            for position in table.x:
                yield _tell(">", table.argument, Number(position))


def _tell(operator: str, left: Expression, right: Expression) -> Expression:
    """Tell by 1 or 0 whether a comparison holds."""
    return FunctionCall("where", (Binary(operator, left, right), _ONE, _ZERO))
