"""Interval arithmetic: between which values an expression lies, whatever its parameters.

The bounds hold, but need not be the tightest: a parameter that occurs twice counts as two. They
are computed in ordinary rounding, so an exact end may be off by the last bit.
"""

from collections.abc import Callable, Mapping
from math import atan, exp, inf, isnan, log, pi, sqrt, tan, tanh
from typing import TypeAlias

from sysid.language.tree import Binary, Call, Expression, Number, Past, Symbol, Unary

Interval: TypeAlias = tuple[float, float]

EVERYTHING: Interval = (-inf, inf)


def bounds(
    expression: Expression, parameters: Mapping[str, Interval], period: float | None = None
) -> Interval:
    """Interval that holds every value of an expression.

    Parameters
    ----------
    expression : Expression
    parameters : mapping of str to (lower, upper)
    period : float or None
        Sampling period h in s; None stands for any positive one.
    """
    match expression:
        case Number(value):
            return (value, value)
        case Symbol():
            return _symbol(expression, parameters, period)
        case Past():
            return EVERYTHING
        case Unary("-", operand):
            return _negative(bounds(operand, parameters, period))
        case Binary(operator, left, right) if operator in _OPERATORS:
            ends = (bounds(one, parameters, period) for one in (left, right))
            return _usable(_OPERATORS[operator](*ends))
        case Call(function, arguments):
            ends = (bounds(one, parameters, period) for one in arguments)
            return _usable(_FUNCTIONS[function](*ends))
        case _:  # a condition: false or true
            return (0.0, 1.0)


def _symbol(symbol: Symbol, parameters: Mapping[str, Interval], period: float | None) -> Interval:
    if symbol.kind == "parameter":
        return parameters[symbol.name]
    if symbol.kind == "period" and period is not None:
        return (period, period)
    return (0.0, inf)


def _usable(interval: Interval) -> Interval:
    return EVERYTHING if isnan(interval[0]) or isnan(interval[1]) else interval


def _negative(a: Interval) -> Interval:
    return (-a[1], -a[0])


def _sum(a: Interval, b: Interval) -> Interval:
    return (a[0] + b[0], a[1] + b[1])


def _difference(a: Interval, b: Interval) -> Interval:
    return (a[0] - b[1], a[1] - b[0])


def _times(a: float, b: float) -> float:
    return 0.0 if a == 0.0 or b == 0.0 else a * b  # an unbounded end is never reached, so 0·∞ = 0


def _product(a: Interval, b: Interval) -> Interval:
    corners = [_times(x, y) for x in a for y in b]
    return (min(corners), max(corners))


def _quotient(a: Interval, b: Interval) -> Interval:
    if b[0] > 0 or b[1] < 0:
        return _product(a, (1 / b[1], 1 / b[0]))
    if b[0] == 0 and b[1] > 0:
        return _product(a, (1 / b[1], inf))
    if b[1] == 0 and b[0] < 0:
        return _product(a, (-inf, 1 / b[0]))
    return EVERYTHING


def _power(a: Interval, b: Interval) -> Interval:
    if b[0] == b[1] and b[0] >= 0 and b[0].is_integer():
        ends = [_raise(x, b[0]) for x in a]
        if b[0] % 2 == 0 and a[0] < 0 < a[1]:
            ends.append(0.0 if b[0] else 1.0)
        return (min(ends), max(ends))
    if a[0] >= 0:  # monotone in either argument, so the ends lie at the corners
        corners = [_raise(x, y) for x in a for y in b]
        return (min(corners), max(corners))
    return EVERYTHING


def _raise(base: float, exponent: float) -> float:
    try:
        return float(base**exponent)
    except OverflowError:
        return -inf if base < 0 and exponent % 2 == 1 else inf
    except ZeroDivisionError:
        return inf


def _rising(function: Callable[[float], float]) -> Callable[[Interval], Interval]:
    return lambda a: (function(a[0]), function(a[1]))


def _exp(x: float) -> float:
    return inf if x > 709.0 else exp(x)


def _log(x: float) -> float:
    return -inf if x <= 0 else log(x)


def _sqrt(x: float) -> float:
    return sqrt(max(x, 0.0))


def _sign(x: float) -> float:
    return float((x > 0) - (x < 0))


def _absolute(a: Interval) -> Interval:
    low = 0.0 if a[0] <= 0 <= a[1] else min(abs(a[0]), abs(a[1]))
    return (low, max(abs(a[0]), abs(a[1])))


def _wave(_: Interval) -> Interval:
    return (-1.0, 1.0)


def _tangent(a: Interval) -> Interval:
    return (tan(a[0]), tan(a[1])) if -pi / 2 < a[0] and a[1] < pi / 2 else EVERYTHING


def _least(a: Interval, b: Interval) -> Interval:
    return (min(a[0], b[0]), min(a[1], b[1]))


def _either(_: Interval, a: Interval, b: Interval) -> Interval:
    return (min(a[0], b[0]), max(a[1], b[1]))


def _greatest(a: Interval, b: Interval) -> Interval:
    return (max(a[0], b[0]), max(a[1], b[1]))


_OPERATORS: Mapping[str, Callable[[Interval, Interval], Interval]] = {
    "+": _sum, "-": _difference, "*": _product, "/": _quotient, "**": _power,
}  # fmt: skip

_FUNCTIONS: Mapping[str, Callable[..., Interval]] = {
    "sin": _wave, "cos": _wave, "tan": _tangent, "exp": _rising(_exp), "log": _rising(_log),
    "sqrt": _rising(_sqrt), "abs": _absolute, "sign": _rising(_sign), "min": _least,
    "max": _greatest, "tanh": _rising(tanh), "atan": _rising(atan),
    "where": _either,
}  # fmt: skip
