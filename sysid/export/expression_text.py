"""Expression trees as source text of a programming language."""

from collections.abc import Mapping
from typing import ClassVar, Protocol

from sysid.language.functions import OPERATORS, Level
from sysid.language.table_functions import TABLE_FUNCTIONS
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

HELPER_ARGUMENTS = {
    "between": "",
    "between_on_grid": ", width",
    "held": ", ramp",
    "averaged": ", half",
    "averaged_on_grid": ", half, ramp",
}
"""Further arguments of the functions that read inputs, after the position."""


class TargetLanguage(Protocol):
    """Syntax in which programming languages differ.

    Attributes
    ----------
    logical_operators : mapping of str to str
        ``and`` and ``or``, where they are other words.
    whole_division : str
        Operator of the division of whole numbers that leaves out the rest.
    length_argument : str
        What a function that reads an input is given for its length, with a comma.
    called_functions : set of str
        Functions that were called and whose text the program may need.
    """

    logical_operators: ClassVar[Mapping[str, str]]
    whole_division: ClassVar[str]
    length_argument: ClassVar[str]
    called_functions: set[str]

    def write_negation(self, condition: str) -> str:
        """Write ``not (…)``, valid anywhere."""

    def write_function_call(self, name: str, arguments: list[str]) -> str:
        """Write a call of a function of the model language."""

    def write_table(self, name: str, argument: str, x: list[str], y: list[str]) -> str:
        """Write a call of a table with its points."""

    def write_power(self, base: str, exponent: str, whole: int | None) -> tuple[str, int]:
        """Write a power and its level; ``**`` may follow `base`, `whole` is a small exponent."""

    def write_choice(self, condition: str, first: str, second: str) -> str:
        """Write ``where``, valid anywhere."""

    def write_constant_dividend(self, above: str) -> str:
        """Write a dividend of numbers only, so that division by zero gives ``inf``."""

    def write_element(self, array: str, index: str, divisor: int) -> str:
        """Write the array element at the whole part of index / divisor."""
        if divisor == 1:
            return f"{array}[{index}]"
        return f"{array}[{f'({index})' if '-' in index else index}{self.whole_division}{divisor}]"

    def write_signal_read(self, helper: str, signal: str, position: str) -> str:
        """Write a call of a helper that reads an input."""
        return f"{helper}({signal}, {self.length_argument}{position}{HELPER_ARGUMENTS[helper]})"

    def write_clamp(self, value: str, least: int, most: int) -> str:
        """Write a number limited to a range."""

    def write_float(self, index: str) -> str:
        """Write a whole number as floating-point number."""

    def write_delay(self, text: str, *, is_whole: bool) -> str:
        """Write a time lag that is not negative; `is_whole`: rounded to whole steps."""

    def write_limit(self, delay: str) -> str:
        """Write a time lag that is at most 1e9 steps, so that its whole part is a number."""

    def open_loop(self, index: str, first: str, *, to_last: bool) -> str:
        """Write the first line of a loop over steps from `first`; `to_last` includes the last."""

    def assign(self, name: str, text: str, *, is_new: bool = False) -> list[str]:
        """Write an assignment on as many lines as needed; `is_new`: it declares the name."""

    def close_loop(self) -> list[str]:
        """Write the end of a loop."""

    def open_parts(self, stem: str, most: int) -> list[str]:
        """Write the first lines of a loop over the parts of a step, with at most `most` switches.

        A part begins at `begin` and ends at `end`, in steps, and takes `duration` in s.
        """

    def close_parts(self) -> list[str]:
        """Write the end of a loop over parts."""


class ExportScope(Protocol):
    """Meaning of names at one position of the program; the texts can stand anywhere."""

    def write_symbol(self, symbol: Symbol) -> str:
        """Write a parameter or a reserved name."""

    def write_past_value(self, past: PastValue) -> str:
        """Write a state or an input, now or in the past."""


def write_expression(
    expression: Expression, language: TargetLanguage, scope: ExportScope, floor: int = 0
) -> str:
    """Write an expression; in parentheses if it binds less than `floor`."""
    written, level = _write_with_level(expression, language, scope)
    return written if level >= floor else f"({written})"


def write_number(value: float) -> str:
    """Write a floating-point number by the shortest text that reproduces it."""
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
    if tree.function in TABLE_FUNCTIONS:
        first, *points = arguments
        half = len(points) // 2
        return language.write_table(tree.function, first, points[:half], points[half:])
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
    """Whether an expression contains no names."""
    return not any(isinstance(node, Symbol | PastValue) for node in walk(expression))


def _find_integer_exponent(base: Expression, exponent: Expression) -> int | None:
    match exponent:
        case Number(value) if value.is_integer() and abs(value) <= 64 and not is_constant(base):
            return int(value)
        case _:
            return None
