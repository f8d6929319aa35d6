"""Code generation from expression trees to vector instructions."""

from collections.abc import Callable, Mapping
from typing import Protocol

from sysid.kernels.table_code import emit_table
from sysid.kernels.vectors import IrValue, VectorBuilder
from sysid.language.functions import FUNCTIONS, OPERATORS, Level
from sysid.language.table_functions import TABLE_FUNCTIONS, split_table
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary

MAX_POWER = 64
"""Largest whole exponent that is expanded to multiplications."""

_ARITHMETIC = {"+": "add", "-": "sub", "*": "mul", "/": "div"}


class Environment(Protocol):
    """Meaning of names at one point of the simulation."""

    def emit_symbol(self, symbol: Symbol) -> IrValue:
        """Emit the value of a parameter or of a reserved name."""

    def emit_past_value(self, past: PastValue) -> IrValue:
        """Emit the value of a state or an input, now or in the past."""


def emit_expression(lanes: VectorBuilder, expression: Expression, scope: Environment) -> IrValue:
    """Emit the instructions of an expression; the result is a scalar or a vector."""
    match expression:
        case Number(value):
            return lanes.make_number(value)
        case Symbol():
            return scope.emit_symbol(expression)
        case PastValue():
            return scope.emit_past_value(expression)
        case Unary("-", operand):
            return lanes.sub(lanes.make_number(-0.0), emit_expression(lanes, operand, scope))
        case Unary(_, operand):
            return lanes.builder.not_(emit_expression(lanes, operand, scope))
        case Binary():
            return _emit_binary(lanes, expression, scope)
        case FunctionCall():
            return _emit_call(lanes, expression, scope)


def evaluate_constant(expression: Expression) -> float | None:
    """Evaluate an expression of numbers only, for exponents; None for any other."""
    match expression:
        case Number(value):
            return value
        case Unary("-", operand):
            inner = evaluate_constant(operand)
            return None if inner is None else -inner
        case Binary("/", left, right):
            above, below = evaluate_constant(left), evaluate_constant(right)
            return above / below if above is not None and below else None
        case _:
            return None


def _emit_binary(lanes: VectorBuilder, expression: Binary, scope: Environment) -> IrValue:
    operator = expression.operator
    left = emit_expression(lanes, expression.left, scope)
    if operator == "**":
        return _emit_power(lanes, left, expression.right, scope)
    right = emit_expression(lanes, expression.right, scope)
    if operator in _ARITHMETIC:
        return getattr(lanes, _ARITHMETIC[operator])(left, right)
    if OPERATORS[operator].level == Level.COMPARISON:
        return lanes.compare(operator, left, right)
    left, right = lanes.match_shapes(left, right)
    return lanes.builder.and_(left, right) if operator == "and" else lanes.builder.or_(left, right)


def _emit_power(
    lanes: VectorBuilder, base: IrValue, exponent: Expression, scope: Environment
) -> IrValue:
    value = evaluate_constant(exponent)
    if value == 0.5:
        return lanes.call_intrinsic("sqrt", base)
    if value is not None and value.is_integer() and abs(value) <= MAX_POWER:
        whole = _emit_whole_power(lanes, base, int(abs(value)))
        return whole if value >= 0 else lanes.div(lanes.make_number(1.0), whole)
    return lanes.call_intrinsic("pow", base, emit_expression(lanes, exponent, scope))


def _emit_whole_power(lanes: VectorBuilder, base: IrValue, exponent: int) -> IrValue:
    """Emit a whole power by repeated squaring; 0 ** 0 = 1."""
    result, square = None, base
    while exponent:
        if exponent & 1:
            result = square if result is None else lanes.mul(result, square)
        exponent >>= 1
        if exponent:
            square = lanes.mul(square, square)
    return lanes.make_number(1.0) if result is None else result


def _emit_call(lanes: VectorBuilder, call: FunctionCall, scope: Environment) -> IrValue:
    function = call.function
    if function in TABLE_FUNCTIONS:
        table = split_table(call)
        position = emit_expression(lanes, table.argument, scope)
        values = [emit_expression(lanes, value, scope) for value in table.y]
        return emit_table(lanes, position, table.x, values, is_cubic=function == "pchip")
    arguments = [emit_expression(lanes, argument, scope) for argument in call.arguments]
    if function == "where":
        return lanes.select(*arguments)
    if function in _INSTRUCTIONS:
        return _INSTRUCTIONS[function](lanes, *arguments)
    return lanes.call_intrinsic(FUNCTIONS[function].llvm, *arguments)


def _emit_sign(lanes: VectorBuilder, value: IrValue) -> IrValue:
    """Emit -1, 0 or 1; nan stays nan."""
    zero = lanes.make_number(0.0)
    negative = lanes.select(lanes.compare("<", value, zero), lanes.make_number(-1.0), value)
    return lanes.select(lanes.compare(">", value, zero), lanes.make_number(1.0), negative)


def _emit_clip(lanes: VectorBuilder, value: IrValue, lower: IrValue, upper: IrValue) -> IrValue:
    above = lanes.call_intrinsic("maximum", value, lower)
    return lanes.call_intrinsic("minimum", above, upper)


def _emit_modulo(lanes: VectorBuilder, value: IrValue, divisor: IrValue) -> IrValue:
    """Emit the remainder with the sign of the divisor; fmod, which is exact, has that of x."""
    rest = lanes.rem(value, divisor)
    is_outside = lanes.compare("<", lanes.mul(rest, divisor), lanes.make_number(0.0))
    return lanes.select(is_outside, lanes.add(rest, divisor), rest)


_INSTRUCTIONS: Mapping[str, Callable[..., IrValue]] = {
    "sign": _emit_sign,
    "clip": _emit_clip,
    "mod": _emit_modulo,
}
