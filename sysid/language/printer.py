"""Printer: from checked trees to text, with as few parentheses as possible."""

from sysid.language.functions import OPERATORS, Level
from sysid.language.monomials import CONSTANT, add_polynomials, collect_terms, to_expression
from sysid.language.table_functions import TABLE_FUNCTIONS
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary


def format_expression(expression: Expression, clock: str = "k") -> str:
    """Format an expression; the text of a parsed tree parses to the same tree.

    Parameters
    ----------
    expression : Expression
    clock : {"k", "t"}
        Origin of past values: ``k`` in the difference form, ``t`` in the differential form.
    """
    return _format_nested(expression, clock, 0)


def _format_nested(expression: Expression, clock: str, floor: int) -> str:
    written, level = _format_with_level(expression, clock)
    return written if level >= floor else f"({written})"


def _format_with_level(expression: Expression, clock: str) -> tuple[str, int]:
    match expression:
        case Number(value):
            return format_number(value), Level.ATOM if value >= 0 else Level.SIGN
        case Symbol(name):
            return name, Level.ATOM
        case PastValue():
            return _format_past_value(expression, clock), Level.ATOM
        case Unary("-", operand):
            return f"-{_format_nested(operand, clock, Level.SIGN)}", Level.SIGN
        case Unary(_, operand):
            return f"not {_format_nested(operand, clock, Level.COMPARISON)}", Level.NOT
        case Binary(operator, left, right):
            return _format_infix(operator, left, right, clock), OPERATORS[operator].level
        case FunctionCall():
            return _format_call(expression, clock), Level.ATOM


def _format_call(call: FunctionCall, clock: str) -> str:
    texts = [_format_nested(argument, clock, 0) for argument in call.arguments]
    if call.function in TABLE_FUNCTIONS:
        argument, *points = texts
        half = len(points) // 2
        lists = (", ".join(values) for values in (points[:half], points[half:]))
        return f"{call.function}({argument}, [{'], ['.join(lists)}])"
    return f"{call.function}({', '.join(texts)})"


def _format_infix(operator: str, left: Expression, right: Expression, clock: str) -> str:
    level = OPERATORS[operator].level
    grows_right = operator == "**"
    before = _format_nested(
        left, clock, level + 1 if grows_right or level == Level.COMPARISON else level
    )
    after = _format_nested(right, clock, Level.SIGN if grows_right else level + 1)
    space = " " if level <= Level.SUM else ""
    return f"{before}{space}{operator}{space}{after}"


def _format_past_value(value: PastValue, clock: str) -> str:
    back = collect_terms(Number(float(value.offset)))
    if value.delay is not None:
        back = add_polynomials(back, collect_terms(value.delay))
    constant = back.pop(CONSTANT, 0.0)
    whole = f"-{format_number(constant)}" if constant else ""
    delay = _format_nested(to_expression(back), clock, Level.PRODUCT)
    index = f"{clock}{whole} - {delay}" if back else f"{clock}{whole}"
    return value.name if index == clock else f"{value.name}({index})"


def format_number(value: float) -> str:
    """Format a number as the shortest exact text; whole numbers without a decimal point."""
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
