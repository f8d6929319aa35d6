"""From expression trees to vector instructions."""

from typing import Protocol

from sysid.kernels.vectors import Lanes, Value
from sysid.language.functions import FUNCTIONS, OPERATORS, Level
from sysid.language.tree import Binary, Call, Expression, Number, Past, Symbol, Unary

LARGEST_POWER = 64
"""Whole exponents up to this one are written as multiplications."""

_ARITHMETIC = {"+": "add", "-": "sub", "*": "mul", "/": "div"}


class Scope(Protocol):
    """What names stand for at one place of the simulation."""

    def symbol(self, symbol: Symbol) -> Value:
        """Value of a parameter or of a reserved name."""

    def past(self, past: Past) -> Value:
        """Value of a state or an input, now or in the past."""


def emit(lanes: Lanes, expression: Expression, scope: Scope) -> Value:
    """Instructions that compute an expression; the result is a scalar or a vector."""
    match expression:
        case Number(value):
            return lanes.number(value)
        case Symbol():
            return scope.symbol(expression)
        case Past():
            return scope.past(expression)
        case Unary("-", operand):
            return lanes.sub(lanes.number(-0.0), emit(lanes, operand, scope))
        case Unary(_, operand):
            return lanes.builder.not_(emit(lanes, operand, scope))
        case Binary():
            return _binary(lanes, expression, scope)
        case Call():
            arguments = [emit(lanes, argument, scope) for argument in expression.arguments]
            return _call(lanes, expression.function, arguments)


def constant(expression: Expression) -> float | None:
    """Value of an expression of numbers only, for exponents; None for any other."""
    match expression:
        case Number(value):
            return value
        case Unary("-", operand):
            inner = constant(operand)
            return None if inner is None else -inner
        case Binary("/", left, right):
            above, below = constant(left), constant(right)
            return above / below if above is not None and below else None
        case _:
            return None


def _binary(lanes: Lanes, expression: Binary, scope: Scope) -> Value:
    operator = expression.operator
    left = emit(lanes, expression.left, scope)
    if operator == "**":
        return _power(lanes, left, expression.right, scope)
    right = emit(lanes, expression.right, scope)
    if operator in _ARITHMETIC:
        return getattr(lanes, _ARITHMETIC[operator])(left, right)
    if OPERATORS[operator].level == Level.COMPARISON:
        return lanes.compare(operator, left, right)
    left, right = lanes.same_shape(left, right)
    return lanes.builder.and_(left, right) if operator == "and" else lanes.builder.or_(left, right)


def _power(lanes: Lanes, base: Value, exponent: Expression, scope: Scope) -> Value:
    value = constant(exponent)
    if value == 0.5:
        return lanes.intrinsic("sqrt", base)
    if value is not None and value.is_integer() and abs(value) <= LARGEST_POWER:
        whole = _whole_power(lanes, base, int(abs(value)))
        return whole if value >= 0 else lanes.div(lanes.number(1.0), whole)
    return lanes.intrinsic("pow", base, emit(lanes, exponent, scope))


def _whole_power(lanes: Lanes, base: Value, exponent: int) -> Value:
    """Base to a whole power by squaring; 0 ** 0 = 1."""
    result, square = None, base
    while exponent:
        if exponent & 1:
            result = square if result is None else lanes.mul(result, square)
        exponent >>= 1
        if exponent:
            square = lanes.mul(square, square)
    return lanes.number(1.0) if result is None else result


def _call(lanes: Lanes, function: str, arguments: list[Value]) -> Value:
    if function == "where":
        return lanes.select(*arguments)
    if function == "sign":
        return _sign(lanes, arguments[0])
    return lanes.intrinsic(FUNCTIONS[function].llvm, *arguments)


def _sign(lanes: Lanes, value: Value) -> Value:
    """-1, 0 or 1; nan stays nan."""
    zero = lanes.number(0.0)
    negative = lanes.select(lanes.compare("<", value, zero), lanes.number(-1.0), value)
    return lanes.select(lanes.compare(">", value, zero), lanes.number(1.0), negative)
