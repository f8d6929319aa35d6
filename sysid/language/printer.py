"""Checked trees back to text, with no more parentheses than needed."""

from sysid.language.monomials import CONSTANT, add, collect, rebuild
from sysid.language.tree import Binary, Call, Expression, Number, Past, Symbol, Unary

_LEVEL = {
    "or": 1, "and": 2, "not": 3, "<": 4, "<=": 4, ">": 4, ">=": 4, "==": 4, "!=": 4,
    "+": 5, "-": 5, "*": 6, "/": 6, "**": 8,
}  # fmt: skip
_SIGN = 7
_ATOM = 9


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
            return number(value), _ATOM if value >= 0 else _SIGN
        case Symbol(name):
            return name, _ATOM
        case Past():
            return _past(expression, clock), _ATOM
        case Unary("-", operand):
            return f"-{_text(operand, clock, _SIGN)}", _SIGN
        case Unary(_, operand):
            return f"not {_text(operand, clock, _LEVEL['<'])}", _LEVEL["not"]
        case Binary(operator, left, right):
            return _infix(operator, left, right, clock), _LEVEL[operator]
        case Call(function, arguments):
            inside = ", ".join(_text(one, clock, 0) for one in arguments)
            return f"{function}({inside})", _ATOM


def _infix(operator: str, left: Expression, right: Expression, clock: str) -> str:
    level = _LEVEL[operator]
    grows_right = operator == "**"
    before = _text(left, clock, level + 1 if grows_right or level == _LEVEL["<"] else level)
    after = _text(right, clock, _SIGN if grows_right else level + 1)
    space = " " if level <= _LEVEL["+"] else ""
    return f"{before}{space}{operator}{space}{after}"


def _past(value: Past, clock: str) -> str:
    back = collect(Number(float(value.offset)))
    if value.lag is not None:
        back = add(back, collect(value.lag))
    constant = back.pop(CONSTANT, 0.0)
    whole = f"-{number(constant)}" if constant else ""
    lag = _text(rebuild(back), clock, _LEVEL["*"])
    index = f"{clock}{whole} - {lag}" if back else f"{clock}{whole}"
    return value.name if index == clock else f"{value.name}({index})"


def number(value: float) -> str:
    """Shortest text that gives the number back; without a decimal point where it is whole."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
