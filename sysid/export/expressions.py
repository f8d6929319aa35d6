"""Expression trees as source text of a programming language."""

from collections.abc import Mapping
from typing import Protocol

from sysid.language.functions import OPERATORS, Level
from sysid.language.tree import Binary, Call, Expression, Number, Past, Symbol, Unary, walk

WIDTHS = {"between": "", "held": ", ramp", "averaged": ", half"}
"""What the functions that read inputs are told besides the place."""


class Language(Protocol):
    """What two programming languages write differently."""

    words: Mapping[str, str]
    """``and`` and ``or``."""

    def negation(self, condition: str) -> str:
        """``not (…)``, to stand anywhere."""

    def function(self, name: str, arguments: list[str]) -> str:
        """A call of a function of the model language."""

    def power(self, base: str, exponent: str, whole: int | None) -> tuple[str, int]:
        """A power and its level; `base` may be followed by ``**``, `whole` is a small exponent."""

    def choice(self, condition: str, first: str, second: str) -> str:
        """``where``, to stand anywhere."""

    def quotient(self, above: str) -> str:
        """A dividend of numbers only, so that division by zero gives ``inf``."""

    def element(self, array: str, index: str, divisor: int) -> str:
        """Array at the whole part of index / divisor."""

    def read(self, helper: str, signal: str, place: str) -> str:
        """A call of ``between`` or ``held``."""

    def limited(self, value: str, least: int, most: int) -> str:
        """A number held between two others."""

    def real(self, index: str) -> str:
        """A whole number as floating-point number."""

    def lag(self, text: str, *, is_whole: bool) -> str:
        """A lag that is not negative; `is_whole`: of the nearest whole number of steps."""

    def open_loop(self, index: str, first: int, *, to_last: bool) -> str:
        """First line of a loop over the steps from `first` on, the last one too if asked for."""

    def assign(self, name: str, text: str, *, is_new: bool = False) -> list[str]:
        """An assignment, on as many lines as it needs; `is_new`: of a name that it declares."""

    def close_loop(self) -> list[str]:
        """What ends a loop."""


class Scope(Protocol):
    """What names stand for at one place of the program; the texts are to stand anywhere."""

    def symbol(self, symbol: Symbol) -> str:
        """A parameter or a reserved name."""

    def past(self, past: Past) -> str:
        """A state or an input, now or in the past."""


def source(expression: Expression, language: Language, scope: Scope, floor: int = 0) -> str:
    """Text of an expression; in parentheses if it binds less than `floor`."""
    written, level = _written(expression, language, scope)
    return written if level >= floor else f"({written})"


def number(value: float) -> str:
    """Shortest text that gives the number back, and is one of floating point."""
    return repr(float(value))


def _written(expression: Expression, language: Language, scope: Scope) -> tuple[str, int]:
    match expression:
        case Number(value):
            return number(value), Level.ATOM if value >= 0 else Level.SIGN
        case Symbol():
            return scope.symbol(expression), Level.ATOM
        case Past():
            return scope.past(expression), Level.ATOM
        case Unary():
            return _prefix(expression, language, scope)
        case Binary("**", base, exponent):
            return language.power(
                source(base, language, scope, Level.ATOM), source(exponent, language, scope),
                _whole(base, exponent),
            )  # fmt: skip
        case Binary():
            return _infix(expression, language, scope), OPERATORS[expression.operator].level
        case Call():
            return _call(expression, language, scope), Level.ATOM


def _prefix(tree: Unary, language: Language, scope: Scope) -> tuple[str, int]:
    if tree.operator == "-":
        return f"-{source(tree.operand, language, scope, Level.SIGN + 1)}", Level.SIGN
    return language.negation(source(tree.operand, language, scope)), Level.ATOM


def _call(tree: Call, language: Language, scope: Scope) -> str:
    arguments = [source(one, language, scope) for one in tree.arguments]
    if tree.function == "where":
        condition, first, second = arguments
        return language.choice(condition, first, second)
    return language.function(tree.function, arguments)


def _infix(tree: Binary, language: Language, scope: Scope) -> str:
    level = OPERATORS[tree.operator].level
    logical = level <= Level.COMPARISON
    beside = Level.COMPARISON + (level == Level.COMPARISON)
    before = source(tree.left, language, scope, beside if logical else level)
    after = source(tree.right, language, scope, beside if logical else level + 1)
    if tree.operator == "/" and is_number(tree):
        before = language.quotient(before)
    operator = language.words.get(tree.operator, tree.operator)
    space = " " if level <= Level.SUM else ""
    return f"{before}{space}{operator}{space}{after}"


def is_number(expression: Expression) -> bool:
    """Whether an expression has no names in it."""
    return not any(isinstance(node, Symbol | Past) for node in walk(expression))


def _whole(base: Expression, exponent: Expression) -> int | None:
    match exponent:
        case Number(value) if value.is_integer() and abs(value) <= 64 and not is_number(base):
            return int(value)
        case _:
            return None
