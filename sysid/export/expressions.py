"""Expression trees as source text of a programming language."""

from collections.abc import Mapping
from typing import Protocol

from sysid.language.functions import OPERATORS, Level
from sysid.language.tree import (
    Binary,
    Expression,
    FunctionCall,
    Number,
    PastValue,
    Symbol,
    Unary,
    walk,
)

HELPER_ARGUMENTS = {"between": "", "held": ", ramp", "averaged": ", half"}
"""What the functions that read inputs are told besides the place."""


class TargetLanguage(Protocol):
    """What two programming languages write differently."""

    logical_operators: Mapping[str, str]
    """``and`` and ``or``."""

    def write_negation(self, condition: str) -> str:
        """``not (…)``, to stand anywhere."""

    def write_function_call(self, name: str, arguments: list[str]) -> str:
        """A call of a function of the model language."""

    def write_power(self, base: str, exponent: str, whole: int | None) -> tuple[str, int]:
        """A power and its level; `base` may be followed by ``**``, `whole` is a small exponent."""

    def write_choice(self, condition: str, first: str, second: str) -> str:
        """``where``, to stand anywhere."""

    def write_constant_dividend(self, above: str) -> str:
        """A dividend of numbers only, so that division by zero gives ``inf``."""

    def write_element(self, array: str, index: str, divisor: int) -> str:
        """Array at the whole part of index / divisor."""

    def write_signal_read(self, helper: str, signal: str, place: str) -> str:
        """A call of ``between`` or ``held``."""

    def write_clamp(self, value: str, least: int, most: int) -> str:
        """A number held between two others."""

    def write_float(self, index: str) -> str:
        """A whole number as floating-point number."""

    def lag(self, text: str, *, is_whole: bool) -> str:
        """A lag that is not negative; `is_whole`: of the nearest whole number of steps."""

    def open_loop(self, index: str, first: int, *, to_last: bool) -> str:
        """First line of a loop over the steps from `first` on, the last one too if asked for."""

    def assign(self, name: str, text: str, *, is_new: bool = False) -> list[str]:
        """An assignment, on as many lines as it needs; `is_new`: of a name that it declares."""

    def close_loop(self) -> list[str]:
        """What ends a loop."""


class ExportScope(Protocol):
    """What names stand for at one place of the program; the texts are to stand anywhere."""

    def write_symbol(self, symbol: Symbol) -> str:
        """A parameter or a reserved name."""

    def write_past_value(self, past: PastValue) -> str:
        """A state or an input, now or in the past."""


def write_expression(
    expression: Expression, language: TargetLanguage, scope: ExportScope, floor: int = 0
) -> str:
    """Text of an expression; in parentheses if it binds less than `floor`."""
    written, level = _write_with_level(expression, language, scope)
    return written if level >= floor else f"({written})"


def write_number(value: float) -> str:
    """Shortest text that gives the number back, and is one of floating point."""
    return repr(float(value))


def _write_with_level(
    expression: Expression, language: TargetLanguage, scope: ExportScope
) -> tuple[str, int]:
    match expression:
        case Number(value):
            return write_number(value), Level.ATOM if value >= 0 else Level.SIGN
        case Symbol():
            return scope.write_symbol(expression), Level.ATOM
        case PastValue():
            return scope.write_past_value(expression), Level.ATOM
        case Unary():
            return _write_unary(expression, language, scope)
        case Binary("**", base, exponent):
            return language.write_power(
                write_expression(base, language, scope, Level.ATOM),
                write_expression(exponent, language, scope),
                _find_integer_exponent(base, exponent),
            )
        case Binary():
            return _write_binary(expression, language, scope), OPERATORS[expression.operator].level
        case FunctionCall():
            return _write_call(expression, language, scope), Level.ATOM


def _write_unary(tree: Unary, language: TargetLanguage, scope: ExportScope) -> tuple[str, int]:
    if tree.operator == "-":
        return f"-{write_expression(tree.operand, language, scope, Level.SIGN + 1)}", Level.SIGN
    return language.write_negation(write_expression(tree.operand, language, scope)), Level.ATOM


def _write_call(tree: FunctionCall, language: TargetLanguage, scope: ExportScope) -> str:
    arguments = [write_expression(argument, language, scope) for argument in tree.arguments]
    if tree.function == "where":
        condition, first, second = arguments
        return language.write_choice(condition, first, second)
    return language.write_function_call(tree.function, arguments)


def _write_binary(tree: Binary, language: TargetLanguage, scope: ExportScope) -> str:
    level = OPERATORS[tree.operator].level
    logical = level <= Level.COMPARISON
    operand_level = Level.COMPARISON + (level == Level.COMPARISON)
    before = write_expression(tree.left, language, scope, operand_level if logical else level)
    after = write_expression(tree.right, language, scope, operand_level if logical else level + 1)
    if tree.operator == "/" and is_constant(tree):
        before = language.write_constant_dividend(before)
    operator = language.logical_operators.get(tree.operator, tree.operator)
    space = " " if level <= Level.SUM else ""
    return f"{before}{space}{operator}{space}{after}"


def is_constant(expression: Expression) -> bool:
    """Whether an expression has no names in it."""
    return not any(isinstance(node, Symbol | PastValue) for node in walk(expression))


def _find_integer_exponent(base: Expression, exponent: Expression) -> int | None:
    match exponent:
        case Number(value) if value.is_integer() and abs(value) <= 64 and not is_constant(base):
            return int(value)
        case _:
            return None
