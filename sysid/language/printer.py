"""Checked trees back to text, with no more parentheses than needed."""

from sysid.language.functions import OPERATORS, Level
from sysid.language.monomials import CONSTANT, add, collect, rebuild
from sysid.language.tree import Binary, Call, Expression, Number, Past, Symbol, Unary


def text(expression: Expression, clock: str = "k") -> str:
    """Text of the expression, which parses to the same tree if that came from a text.

    Parameters
    ----------
    expression : Expression
    clock : {"k", "t"}
        What past values are counted from: ``k`` in the difference form, ``t`` in the differential.
    """
    return _text(expression, clock, 0)


def _text(expression: Expression, clock: str, floor: int) -> str:
    written, level = _written(expression, clock)
    return written if level >= floor else f"({written})"


def _written(expression: Expression, clock: str) -> tuple[str, int]:
    match expression:
        case Number(value):
            return number(value), Level.ATOM if value >= 0 else Level.SIGN
        case Symbol(name):
            return name, Level.ATOM
        case Past():
            return _past(expression, clock), Level.ATOM
        case Unary("-", operand):
            return f"-{_text(operand, clock, Level.SIGN)}", Level.SIGN
        case Unary(_, operand):
            return f"not {_text(operand, clock, Level.COMPARISON)}", Level.NOT
        case Binary(operator, left, right):
            return _infix(operator, left, right, clock), OPERATORS[operator].level
        case Call(function, arguments):
            inside = ", ".join(_text(one, clock, 0) for one in arguments)
            return f"{function}({inside})", Level.ATOM


def _infix(operator: str, left: Expression, right: Expression, clock: str) -> str:
    level = OPERATORS[operator].level
    grows_right = operator == "**"
    before = _text(left, clock, level + 1 if grows_right or level == Level.COMPARISON else level)
    after = _text(right, clock, Level.SIGN if grows_right else level + 1)
    space = " " if level <= Level.SUM else ""
    return f"{before}{space}{operator}{space}{after}"


def _past(value: Past, clock: str) -> str:
    back = collect(Number(float(value.offset)))
    if value.lag is not None:
        back = add(back, collect(value.lag))
    constant = back.pop(CONSTANT, 0.0)
    whole = f"-{number(constant)}" if constant else ""
    lag = _text(rebuild(back), clock, Level.PRODUCT)
    index = f"{clock}{whole} - {lag}" if back else f"{clock}{whole}"
    return value.name if index == clock else f"{value.name}({index})"


def number(value: float) -> str:
    """Shortest text that gives the number back; without a decimal point where it is whole."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
