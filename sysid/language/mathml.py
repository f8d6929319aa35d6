"""MathML: expressions as they are written by hand, with fractions, powers and Greek letters.

The text is parsed only, not checked. So constants and intermediate names keep their names. The
result is presentation MathML (W3C MathML Core), which browsers show without any library.
"""

import re
from collections.abc import Iterable, Sequence
from html import escape
from html.entities import name2codepoint

from sysid.language.functions import FUNCTIONS, OPERATORS, Level
from sysid.language.parser import (
    Apply,
    Infix,
    Name,
    NumberLiteral,
    Points,
    Prefix,
    SyntaxNode,
    parse_expression,
)
from sysid.language.printer import format_number

_GREEK = {name: chr(code) for name, code in name2codepoint.items() if 0x391 <= code <= 0x3C9}
_NAME = re.compile(r"([^\W\d_]+)(?:_(\w+)|([0-9]+))")
"""A name with a subscript: ``F_max``, ``y0``."""
_SIGNS = {"-": "−", "*": "⋅", "<=": "≤", ">=": "≥", "!=": "≠", "==": "="}
_FUNCTION_NAMES = {"log": "ln", "log10": "lg", "sign": "sgn", "atan": "arctan"}
_FENCES = {"abs": ("|", "|"), "floor": ("⌊", "⌋")}
_LONG_SUM = 8
"""Sums of more terms are folded by the parser; they are shown as one sum again."""


def format_mathml(text: str) -> str:
    """Format an expression of the language as MathML, without the outer ``<math>``.

    Parameters
    ----------
    text : str
        A valid expression.

    Raises
    ------
    ValueError
        If the text cannot be parsed.

    Examples
    --------
    >>> format_mathml("K/T_1")  # doctest: +ELLIPSIS
    '<mfrac><mrow displaystyle="true"><mi>K</mi>...</mfrac>'
    """
    return _format(_parse(text))


def format_terms(text: str) -> list[str]:
    """Format the terms of a sum as MathML, each with its sign; a long sum is broken there.

    Raises
    ------
    ValueError
        If the text cannot be parsed.

    Examples
    --------
    >>> format_terms("u - x")
    ['<mi>u</mi>', '<mo form="infix">−</mo><mi>x</mi>']
    """
    return _format_sum(_parse(text))


def format_name(name: str) -> str:
    """Format a name as MathML: ``F_max`` has a subscript, ``omega`` is a Greek letter.

    Examples
    --------
    >>> format_name("omega")
    '<mi>ω</mi>'
    """
    parts = _NAME.fullmatch(name)
    if parts is None:
        return f"<mi>{escape(_GREEK.get(name, name))}</mi>"
    subscript = parts[2] or parts[3]
    tag = "mn" if subscript.isdecimal() else "mi"
    written = escape(_GREEK.get(subscript, subscript))
    return f"<msub>{format_name(parts[1])}<{tag}>{written}</{tag}></msub>"


def _parse(text: str) -> SyntaxNode:
    node, faults = parse_expression(text)
    if node is None or faults:
        raise ValueError(f"{text!r}, column {faults[0].column}: {faults[0].detail}")
    return node


def _format(node: SyntaxNode) -> str:
    match node:
        case NumberLiteral(value):
            return _format_number(value)
        case Name(name):
            return format_name(name)
        case Prefix("-", operand):
            return f'<mo form="prefix">−</mo>{_nest(operand, Level.PRODUCT)}'
        case Prefix(_, operand):
            return f"{_write_word('not')}{_nest(operand, Level.COMPARISON)}"
        case Infix():
            return _format_infix(node)
        case Apply():
            return _format_apply(node)
        case Points(items):
            return f"<mo>[</mo>{_join(items)}<mo>]</mo>"


def _format_number(value: float) -> str:
    digits, _, power = format_number(value).partition("e")
    number = f"<mn>{digits}</mn>"
    if not power:
        return number
    exponent = f"<mn>{abs(int(power))}</mn>"
    if int(power) < 0:
        exponent = f"<mrow><mo>−</mo>{exponent}</mrow>"
    return f"{number}<mo>⋅</mo><msup><mn>10</mn>{exponent}</msup>"


def _format_infix(node: Infix) -> str:
    operator, left, right = node.operator, node.left, node.right
    if operator == "/":
        return f"<mfrac>{_keep_size(_format(left))}{_keep_size(_format(right))}</mfrac>"
    if operator == "**":
        return f"<msup>{_group(_nest(left, Level.ATOM))}{_group(_format(right))}</msup>"
    if operator in ("+", "-"):
        return "".join(_format_sum(node))
    level = OPERATORS[operator].level
    # A sign at the very beginning of a product needs no parentheses.
    bare = level == Level.PRODUCT and _begins_with_sign(left)
    before = _format(left) if bare else _nest(left, level + (level == Level.COMPARISON))
    sign = operator if operator in _SIGNS or not operator.isalpha() else ""
    between = f"<mo>{escape(_SIGNS.get(sign, sign))}</mo>" if sign else _write_word(operator)
    return f"{before}{between}{_nest(right, level + 1)}"


def _format_sum(node: SyntaxNode) -> list[str]:
    terms = _list_terms(node, "+", is_folded=True)
    if len(terms) <= _LONG_SUM:
        terms = _list_terms(node, "+", is_folded=False)
    (_, first), *others = terms
    texts = [_format(first) if len(terms) == 1 else _nest(first, Level.SUM)]
    return texts + [
        f'<mo form="infix">{_SIGNS.get(sign, sign)}</mo>{_nest(term, Level.PRODUCT)}'
        for sign, term in others
    ]


def _list_terms(node: SyntaxNode, sign: str, *, is_folded: bool) -> list[tuple[str, SyntaxNode]]:
    """List the terms of a sum with their signs; with `is_folded` also those after a minus."""
    if not isinstance(node, Infix) or node.operator not in ("+", "-"):
        return [(sign, node)]
    before = _list_terms(node.left, sign, is_folded=is_folded)
    if node.operator == "-" and not is_folded:
        return [*before, ("-" if sign == "+" else "+", node.right)]
    flipped = sign if node.operator == "+" else "-" if sign == "+" else "+"
    return before + _list_terms(node.right, flipped, is_folded=is_folded)


def _format_apply(node: Apply) -> str:
    match node:
        case Apply("where", (_, _, _)):
            return _format_cases(node)
        case Apply("sqrt", (argument,)):
            return f"<msqrt>{_format(argument)}</msqrt>"
        case Apply(("abs" | "floor") as fence, (argument,)):
            opening, closing = _FENCES[fence]
            bar = '<mo stretchy="true" form="{}">{}</mo>'
            ends = bar.format("prefix", opening), bar.format("postfix", closing)
            return _group(ends[0] + _format(argument) + ends[1])
    name = _FUNCTION_NAMES.get(node.name, node.name)
    head = f"<mi>{name}</mi>" if node.name in FUNCTIONS else format_name(node.name)
    return f"{head}<mo>\u2061</mo>{_fence(_join(node.arguments))}"


def _format_cases(node: SyntaxNode) -> str:
    """Format ``where``: one line for each branch; a branch that is another ``where`` goes on."""
    rows: list[tuple[str, ...]] = []
    rest: SyntaxNode = node
    while isinstance(rest, Apply) and rest.name == "where":
        condition, value, rest = rest.arguments
        rows.append((_format(value), _write_word("if") + _format(condition)))
    rows.append((_format(rest), _write_word("otherwise")))
    return f'<mrow><mo stretchy="true" form="prefix">{{</mo>{format_table(rows)}</mrow>'


def format_table(rows: Iterable[Sequence[str]]) -> str:
    """Format rows of MathML below each other, aligned on the left."""
    cell = '<mtd style="text-align: left">{}</mtd>'
    lines = ("".join(cell.format(_keep_size(content)) for content in row) for row in rows)
    return f"<mtable>{''.join(f'<mtr>{line}</mtr>' for line in lines)}</mtable>"


def _write_word(word: str) -> str:
    return f"<mtext>\u00a0{word}\u00a0</mtext>"


def _join(items: tuple[SyntaxNode, ...]) -> str:
    return "<mo>,</mo>".join(_format(item) for item in items)


def _nest(node: SyntaxNode, floor: int) -> str:
    """Format a node, in parentheses if it binds less tightly than `floor`."""
    return _format(node) if _find_level(node) >= floor else _fence(_format(node))


def _find_level(node: SyntaxNode) -> int:
    """Find how tightly a node binds as it is shown; a fraction and a sign differ from the text."""
    match node:
        case NumberLiteral(value):
            return Level.PRODUCT if "e" in format_number(value) else Level.ATOM
        case Prefix("-", _):
            return Level.SUM
        case Prefix(_, _):
            return Level.NOT
        case Infix("/", _, _):
            return Level.POWER
        case Infix(operator, _, _):
            return Level.SUM if _begins_with_sign(node) else OPERATORS[operator].level
        case _:
            return Level.ATOM


def _begins_with_sign(node: SyntaxNode) -> bool:
    match node:
        case Prefix("-", _):
            return True
        case Infix("*", left, _):
            return _begins_with_sign(left)
        case _:
            return False


def _fence(content: str) -> str:
    return f"<mrow><mo>(</mo>{content}<mo>)</mo></mrow>"


def _group(content: str) -> str:
    """Make one element of what may be several, where MathML counts its children."""
    return f"<mrow>{content}</mrow>"


def _keep_size(content: str) -> str:
    """Make one element in which fractions are as large as outside."""
    return f'<mrow displaystyle="true">{content}</mrow>'
