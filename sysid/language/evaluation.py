"""The value of an expression that has no signals in it: of a tie between parameters."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sysid.language.tree import Binary, Call, Expression, Number, Symbol, Unary

_OPERATORS: Mapping[str, Callable[..., Any]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "/": np.divide, "**": np.power,
    "<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal,
    "==": np.equal, "!=": np.not_equal, "and": np.logical_and, "or": np.logical_or,
}  # fmt: skip
_FUNCTIONS: Mapping[str, Callable[..., Any]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "exp": np.exp, "log": np.log, "sqrt": np.sqrt,
    "abs": np.abs, "sign": np.sign, "min": np.minimum, "max": np.maximum, "tanh": np.tanh,
    "atan": np.arctan,
}  # fmt: skip


def value(expression: Expression, parameters: Mapping[str, float]) -> float:
    """What an expression of parameters and numbers is worth; ``nan`` or ``inf`` where undefined.

    Past values, time and the sampling period have no place in it.
    """
    with np.errstate(all="ignore"):
        return float(_value(expression, parameters))


def _value(expression: Expression, parameters: Mapping[str, float]) -> np.float64:
    match expression:
        case Number(number):
            return np.float64(number)
        case Symbol(name, "parameter"):
            return np.float64(parameters[name])
        case Unary(operator, operand):
            inside = _value(operand, parameters)
            return np.float64(-inside if operator == "-" else not inside)
        case Binary(operator, left, right):
            ends = _value(left, parameters), _value(right, parameters)
            return np.float64(_OPERATORS[operator](*ends))
        case Call("where", (condition, first, second)):
            return _value(first if _value(condition, parameters) else second, parameters)
        case Call(function, arguments):
            values = (_value(one, parameters) for one in arguments)
            return np.float64(_FUNCTIONS[function](*values))
        case _:
            return np.float64(math.nan)
