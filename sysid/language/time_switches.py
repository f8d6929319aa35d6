"""Switches in time: where an expression of ``t`` and parameters alone jumps or bends.

``where(t > tlag, …)`` jumps at tlag, ``max(t - tlag, 0)`` bends there. An integration step across
such a time is of order one, and its result does not move with tlag, or jumps. So a step ends just
before a switch, and the next begins just behind it.

A switch is told by its *side*, an expression that is a whole number and changes at the switch only.
"""

from collections.abc import Callable, Iterable, Mapping

from sysid.language.delays import collect_past_values, mentions_time
from sysid.language.tree import Binary, Expression, FunctionCall, Number, walk

_ORDERINGS = ("<", "<=", ">", ">=")
_ZERO, _HALF, _ONE = Number(0.0), Number(0.5), Number(1.0)

HALVINGS = 52
"""Bisections that locate a switch: of a step as many as a number has binary digits."""


def list_sides(trees: Iterable[Expression]) -> tuple[Expression, ...]:
    """List the sides of all switches in time of some expressions, each once.

    A switch that a signal has a part in, such as ``max(x, t)``, is none in time. Equality holds at
    single times, and has no sides. Nor has a table: it bends at each of its points, and to locate
    all of them would take longer than the steps that its bends need.
    """
    found = [side for tree in trees for node in walk(tree) for side in _list_node_sides(node)]
    return tuple(side for side in dict.fromkeys(found) if _depends_on_time_alone(side))


def _depends_on_time_alone(tree: Expression) -> bool:
    return mentions_time(tree) and not collect_past_values(tree)


def _list_node_sides(node: Expression) -> list[Expression]:
    """List the sides of a node, also of one that depends on signals."""
    match node:
        case Binary(operator, left, right) if operator in _ORDERINGS:
            return [_tell(operator, left, right)]
        case FunctionCall(function) if function in _SIDES:
            return _SIDES[function](node)
        case _:
            return []


def _tell(operator: str, left: Expression, right: Expression) -> Expression:
    """Tell by 1 or 0 whether a comparison holds."""
    return FunctionCall("where", (Binary(operator, left, right), _ONE, _ZERO))


def _list_signs(call: FunctionCall) -> list[Expression]:
    return [_tell(operator, call.arguments[0], _ZERO) for operator in (">", "<")]


def _list_larger(call: FunctionCall) -> list[Expression]:
    return [_tell(">", *call.arguments)]  # of two: of more, the checker makes pairs


def _list_limits(call: FunctionCall) -> list[Expression]:
    argument, *limits = call.arguments
    return [_tell(">", argument, limit) for limit in limits]


def _list_periods(call: FunctionCall) -> list[Expression]:
    """List the number of the period, rounded, so that it changes exactly where the rest does."""
    argument, period = call.arguments
    periods = Binary("/", Binary("-", argument, call), period)
    return [FunctionCall("floor", (Binary("+", periods, _HALF),))]


_SIDES: Mapping[str, Callable[[FunctionCall], list[Expression]]] = {
    "sign": _list_signs,
    "abs": _list_signs,
    "min": _list_larger,
    "max": _list_larger,
    "clip": _list_limits,
    "floor": lambda call: [call],
    "mod": _list_periods,
}
