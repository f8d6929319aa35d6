"""Evaluation of expressions without signals: ties between parameters, waveforms of t.

NumPy computes them directly, because a kernel does not pay for a few values.
"""

from collections.abc import Mapping
from math import nan
from typing import Any

import numpy as np

from sysid.core.types import FloatArray
from sysid.language.functions import FUNCTIONS, OPERATORS
from sysid.language.table_functions import TABLE_FUNCTIONS, evaluate_table
from sysid.language.tree import Binary, Expression, FunctionCall, Number, Symbol, Unary


def evaluate_expression(expression: Expression, parameters: Mapping[str, float]) -> float:
    """Evaluate an expression of parameters and numbers; ``nan`` or ``inf`` where undefined.

    It must not contain past values, time or the sampling period.
    """
    with np.errstate(all="ignore"):
        return float(_evaluate_node(expression, {k: np.float64(v) for k, v in parameters.items()}))


def evaluate_signal(expression: Expression, times: FloatArray) -> FloatArray:
    """Evaluate an expression of ``t``, ``k`` and ``h`` at regular times (N,) in s.

    It must not contain past values or parameters.
    """
    period = times[1] - times[0]
    named = {"t": times, "k": np.arange(float(times.size)), "h": period}
    with np.errstate(all="ignore"):
        return np.array(
            np.broadcast_to(_evaluate_node(expression, named), times.shape), dtype=np.float64
        )


def _load_special() -> Any:
    from scipy import special  # slow to load, rarely needed

    return special


def _evaluate_node(expression: Expression, named: Mapping[str, Any]) -> Any:
    match expression:
        case Number(number):
            return np.float64(number)
        case Symbol(name, kind) if kind == "parameter" or name in named:
            return named[name]
        case Unary(operator, operand):
            inside = _evaluate_node(operand, named)
            return -inside if operator == "-" else np.logical_not(inside)
        case Binary(operator, left, right):
            operands = (_evaluate_node(left, named), _evaluate_node(right, named))
            return getattr(np, OPERATORS[operator].numpy)(*operands)
        case FunctionCall(function, arguments):
            values = [_evaluate_node(argument, named) for argument in arguments]
            if function in TABLE_FUNCTIONS:
                return evaluate_table(function, *values)
            name = FUNCTIONS[function].numpy
            return getattr(np if hasattr(np, name) else _load_special(), name)(*values)
        case _:
            return np.float64(nan)
