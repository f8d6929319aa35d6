"""Interval arithmetic: bounds of an expression for all values of its parameters.

The bounds hold but may not be tight, because a parameter that occurs twice counts as two. They
are computed with ordinary rounding, so an exact end may be off by the last bit.
"""

from collections.abc import Mapping
from math import inf, isnan

from sysid.language.functions import FUNCTIONS, OPERATORS, REAL_LINE, Interval
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary


def bound_expression(
    expression: Expression, parameters: Mapping[str, Interval], period: float | None = None
) -> Interval:
    """Compute an interval that contains every value of an expression.

    Parameters
    ----------
    expression : Expression
    parameters : mapping of str to (lower, upper)
        Also of inputs whose range is known; other signals may have any value.
    period : float or None
        Sampling period h in s; None: any positive value.
    """
    match expression:
        case Number(value):
            return (value, value)
        case Symbol():
            return _bound_symbol(expression, parameters, period)
        case PastValue(name, "input", 0, None):
            return parameters.get(name, REAL_LINE)
        case PastValue():
            return REAL_LINE
        case Unary("-", operand):
            return _negate(bound_expression(operand, parameters, period))
        case Binary(operator, left, right) if (rule := OPERATORS[operator].interval) is not None:
            ends = (bound_expression(operand, parameters, period) for operand in (left, right))
            return _widen_if_nan(rule(*ends))
        case FunctionCall(function, arguments):
            ends = (bound_expression(argument, parameters, period) for argument in arguments)
            return _widen_if_nan(FUNCTIONS[function].interval(*ends))
        case _:  # a condition: false or true
            return (0.0, 1.0)


def _bound_symbol(
    symbol: Symbol, parameters: Mapping[str, Interval], period: float | None
) -> Interval:
    if symbol.kind == "parameter":
        return parameters[symbol.name]
    if symbol.kind == "period" and period is not None:
        return (period, period)
    return (0.0, inf)


def _widen_if_nan(interval: Interval) -> Interval:
    return REAL_LINE if isnan(interval[0]) or isnan(interval[1]) else interval


def _negate(a: Interval) -> Interval:
    return (-a[1], -a[0])
