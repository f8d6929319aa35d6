"""What a checked tree means, as plainly as can be: a reference for compiled code."""

import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from sysid.core.types import FloatArray
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary
from sysid.models.model import FixedInitial, Model

Read = Callable[[PastValue, float], float]

_OPERATORS: Mapping[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "**": math.pow,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "and": lambda a, b: a and b,
    "or": lambda a, b: a or b,
}


def interpolate_pchip(at: float, x: FloatArray, y: FloatArray) -> float:
    """Interpolate by the definition of the library, held beyond the ends."""
    return float(PchipInterpolator(x, y)(np.clip(at, x[0], x[-1])))


FUNCTIONS: Mapping[str, Callable[..., float]] = {
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "exp": math.exp,
    "log": math.log,
    "sqrt": math.sqrt,
    "abs": abs,
    "sign": lambda x: float((x > 0) - (x < 0)),
    "min": min,
    "max": max,
    "where": lambda c, a, b: a if c else b,
    "tanh": math.tanh,
    "atan": math.atan,
    "atan2": math.atan2,
    "sinh": math.sinh,
    "cosh": math.cosh,
    "log10": math.log10,
    "erf": math.erf,
    "floor": lambda x: float(math.floor(x)),
    "mod": lambda x, y: x % y,
    "table": lambda at, *points: float(np.interp(at, *np.reshape(points, (2, -1)))),
    "pchip": lambda at, *points: interpolate_pchip(at, *np.reshape(points, (2, -1))),
    "clip": lambda x, lower, upper: min(max(x, lower), upper),
}


def meaning(tree: Expression, values: Mapping[str, float], read: Read) -> Any:
    """The value of a tree; `read` gives a signal so much further back than its offset."""
    match tree:
        case Number(value):
            return value
        case Symbol(name):
            return values[name]
        case PastValue(_, _, _, lag):
            return read(tree, 0.0 if lag is None else meaning(lag, values, read))
        case Unary("-", operand):
            return -meaning(operand, values, read)
        case Unary(_, operand):
            return not meaning(operand, values, read)
        case Binary(symbol, left, right):
            return _OPERATORS[symbol](meaning(left, values, read), meaning(right, values, read))
        case FunctionCall(function, arguments):
            return FUNCTIONS[function](*(meaning(one, values, read) for one in arguments))


def simulate(
    model: Model, values: Mapping[str, float], inputs: Mapping[str, FloatArray], h: float, n: int
) -> dict[str, FloatArray]:
    """States of a difference model on n samples, history constant and interpolated linearly."""
    assert all(isinstance(start, FixedInitial) for start in model.initial)
    signals = {name: np.array(values) for name, values in inputs.items()}
    for state, start in zip(model.states, model.initial, strict=True):
        signals[state.name] = np.full(n, getattr(start, "value", 0.0))
    for k in range(model.memory, n):

        def read(past: PastValue, lag: float, k: int = k) -> float:
            at = max(k - past.offset - lag, 0.0)
            early = math.floor(at)
            part, signal = at - early, signals[past.name]
            return float(signal[early] if not part else _between(signal, early, part))

        known = {**values, "h": h, "k": float(k), "t": k * h}
        for i in model.order:
            signals[model.states[i].name][k] = meaning(model.equations[i], known, read)
    return {state.name: signals[state.name] for state in model.states}


def _between(signal: FloatArray, early: int, part: float) -> float:
    return float((1 - part) * signal[early] + part * signal[early + 1])
