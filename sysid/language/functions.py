"""Operators and functions of the language, in one table for all layers.

To add a function, add its entry here. If LLVM has no intrinsic for it, write its instructions in
`sysid.kernels.expression_code`, or name it in `sysid.kernels.vectors.LIBRARY_FUNCTIONS`. If C99 or
NumPy has no function for it, write one in `sysid.export`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from math import atan, cosh, erf, exp, floor, inf, isinf, log, log10, pi, sinh, sqrt, tan, tanh
from typing import TypeAlias

Interval: TypeAlias = tuple[float, float]
"""Lower and upper end."""

REAL_LINE: Interval = (-inf, inf)


class Level(IntEnum):
    """Precedence of an operator, from loose to tight; a name is an atom."""

    OR = 1
    AND = 2
    NOT = 3
    COMPARISON = 4
    SUM = 5
    PRODUCT = 6
    SIGN = 7
    POWER = 8
    ATOM = 9


@dataclass(frozen=True, slots=True)
class Operator:
    """An operator between two operands.

    Attributes
    ----------
    level : Level
    numpy : str
        Its name in NumPy.
    interval : function or None
        Interval of its values from those of its operands; None: false or true, 0 or 1.
    """

    level: Level
    numpy: str
    interval: Callable[[Interval, Interval], Interval] | None = None


@dataclass(frozen=True, slots=True)
class Function:
    """A function of the language.

    Attributes
    ----------
    name : str
        In the language.
    interval : function
        Interval of its values from those of its arguments.
    fewest, most : int
        Number of arguments; `most` None: any number, taken pairwise.
    numpy, llvm, c : str
        Names in NumPy, as LLVM intrinsic and in math.h, if they differ from `name`.
    """

    name: str
    interval: Callable[..., Interval]
    fewest: int = 1
    most: int | None = 1
    numpy: str = ""
    llvm: str = ""
    c: str = ""

    def __post_init__(self) -> None:
        for language in ("numpy", "llvm", "c"):
            if not getattr(self, language):
                object.__setattr__(self, language, self.name)


def _add(a: Interval, b: Interval) -> Interval:
    return (a[0] + b[0], a[1] + b[1])


def _subtract(a: Interval, b: Interval) -> Interval:
    return (a[0] - b[1], a[1] - b[0])


def _multiply_ends(a: float, b: float) -> float:
    return 0.0 if a == 0.0 or b == 0.0 else a * b  # an unbounded end is never reached, so 0·∞ = 0


def _multiply(a: Interval, b: Interval) -> Interval:
    corners = [_multiply_ends(x, y) for x in a for y in b]
    return (min(corners), max(corners))


def _divide(a: Interval, b: Interval) -> Interval:
    if b[0] > 0 or b[1] < 0:
        return _multiply(a, (1 / b[1], 1 / b[0]))
    if b[0] == 0 and b[1] > 0:
        return _multiply(a, (1 / b[1], inf))
    if b[1] == 0 and b[0] < 0:
        return _multiply(a, (-inf, 1 / b[0]))
    return REAL_LINE


def _raise_interval(a: Interval, b: Interval) -> Interval:
    if b[0] == b[1] and b[0] >= 0 and b[0].is_integer():
        ends = [_raise_number(x, b[0]) for x in a]
        if b[0] % 2 == 0 and a[0] < 0 < a[1]:
            ends.append(0.0 if b[0] else 1.0)
        return (min(ends), max(ends))
    if a[0] >= 0:  # monotone in either argument, so the ends lie at the corners
        corners = [_raise_number(x, y) for x in a for y in b]
        return (min(corners), max(corners))
    return REAL_LINE


def _raise_number(base: float, exponent: float) -> float:
    try:
        return float(base**exponent)
    except OverflowError:
        return -inf if base < 0 and exponent % 2 == 1 else inf
    except ZeroDivisionError:
        return inf


def _map_monotone(function: Callable[[float], float]) -> Callable[[Interval], Interval]:
    return lambda a: (function(a[0]), function(a[1]))


def _exp(x: float) -> float:
    return inf if x > 709.0 else exp(x)


def _log(x: float) -> float:
    return -inf if x <= 0 else log(x)


def _log10(x: float) -> float:
    return -inf if x <= 0 else log10(x)


def _sinh(x: float) -> float:
    return sinh(x) if abs(x) < 710.0 else inf * x


def _floor(x: float) -> float:
    return x if isinf(x) else float(floor(x))


def _sqrt(x: float) -> float:
    return sqrt(max(x, 0.0))


def _sign(x: float) -> float:
    return float((x > 0) - (x < 0))


def _absolute(a: Interval) -> Interval:
    low = 0.0 if a[0] <= 0 <= a[1] else min(abs(a[0]), abs(a[1]))
    return (low, max(abs(a[0]), abs(a[1])))


def _bound_hyperbolic_cosine(a: Interval) -> Interval:
    low, high = _absolute(a)
    return (cosh(min(low, 710.0)), inf if high > 710.0 else cosh(high))


def _bound_remainder(_: Interval, b: Interval) -> Interval:
    return (min(b[0], 0.0), max(b[1], 0.0))


def _bound_angle(_: Interval, b: Interval) -> Interval:
    return (-pi / 2, pi / 2) if b[0] > 0 else (-pi, pi)


def _bound_wave(_: Interval) -> Interval:
    return (-1.0, 1.0)


def _bound_tangent(a: Interval) -> Interval:
    return (tan(a[0]), tan(a[1])) if -pi / 2 < a[0] and a[1] < pi / 2 else REAL_LINE


def _minimum(a: Interval, b: Interval) -> Interval:
    return (min(a[0], b[0]), min(a[1], b[1]))


def _join_branches(_: Interval, a: Interval, b: Interval) -> Interval:
    return (min(a[0], b[0]), max(a[1], b[1]))


def _maximum(a: Interval, b: Interval) -> Interval:
    return (max(a[0], b[0]), max(a[1], b[1]))


def _join_points(_: Interval, *points: Interval) -> Interval:
    """Interval of a table, linear or monotone: that of its y, behind as many x."""
    y = points[len(points) // 2 :]
    return (min(low for low, _ in y), max(high for _, high in y))


def _clip(a: Interval, lower: Interval, upper: Interval) -> Interval:
    return _minimum(_maximum(a, lower), upper)


OPERATORS: Mapping[str, Operator] = {
    "or": Operator(Level.OR, "logical_or"),
    "and": Operator(Level.AND, "logical_and"),
    "<": Operator(Level.COMPARISON, "less"),
    "<=": Operator(Level.COMPARISON, "less_equal"),
    ">": Operator(Level.COMPARISON, "greater"),
    ">=": Operator(Level.COMPARISON, "greater_equal"),
    "==": Operator(Level.COMPARISON, "equal"),
    "!=": Operator(Level.COMPARISON, "not_equal"),
    "+": Operator(Level.SUM, "add", _add),
    "-": Operator(Level.SUM, "subtract", _subtract),
    "*": Operator(Level.PRODUCT, "multiply", _multiply),
    "/": Operator(Level.PRODUCT, "divide", _divide),
    "**": Operator(Level.POWER, "power", _raise_interval),
}

FUNCTIONS: Mapping[str, Function] = {
    function.name: function
    for function in (
        Function("sin", _bound_wave),
        Function("cos", _bound_wave),
        Function("tan", _bound_tangent),
        Function("exp", _map_monotone(_exp)),
        Function("log", _map_monotone(_log)),
        Function("sqrt", _map_monotone(_sqrt)),
        Function("abs", _absolute, llvm="fabs", c="fabs"),
        Function("sign", _map_monotone(_sign)),
        Function("tanh", _map_monotone(tanh)),
        Function("atan", _map_monotone(atan), numpy="arctan"),
        Function("atan2", _bound_angle, 2, 2, numpy="arctan2"),
        Function("sinh", _map_monotone(_sinh)),
        Function("cosh", _bound_hyperbolic_cosine),
        Function("log10", _map_monotone(_log10)),
        Function("erf", _map_monotone(erf)),
        Function("floor", _map_monotone(_floor)),
        # The remainder has the sign of the divisor, as in MATLAB and NumPy; fmod has not.
        Function("mod", _bound_remainder, 2, 2, c="modulo"),
        Function("clip", _clip, 3, 3),
        # Unlike a comparison, minimum and maximum pass nan on, so that divergence is not hidden.
        Function("min", _minimum, 2, None, numpy="minimum", llvm="minimum", c="least"),
        Function("max", _maximum, 2, None, numpy="maximum", llvm="maximum", c="greatest"),
        Function("where", _join_branches, 3, 3),
        Function("table", _join_points, 3, 3, numpy="interp"),
        Function("pchip", _join_points, 3, 3),
    )
}
