"""Tokenizer and parser of the model language. No text ever reaches Python's own parser.

Precedence from loose to tight: ``or``, ``and``, ``not``, comparison, ``+ -``, ``* /``, unary
``-``, ``**``. The nodes hold unresolved names and their columns. Foreign tokens are classified,
so that the message can say why they are refused.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import isinf
from typing import Literal, NamedTuple, TypeAlias

from sysid.language.functions import OPERATORS, Level
from sysid.language.hints import SIGNS, find_advice

MAX_EXPRESSION_LENGTH = 4000
"""Most characters of one equation."""

MAX_EXPRESSION_DEPTH = 64
"""Deepest nesting of one equation; long sums and products are folded, so they are shallow."""


class TextFault(NamedTuple):
    """A fault of a text.

    Attributes
    ----------
    column : int
        Counted from 1.
    detail : str
        What was wrong, and what would be right.
    """

    column: int
    detail: str


class SyntaxFault(Exception):
    """A text cannot be parsed further; this error does not leave the package."""

    def __init__(self, column: int, detail: str) -> None:
        super().__init__(detail)
        self.fault = TextFault(column, detail)


@dataclass(frozen=True, slots=True)
class NumberLiteral:
    """A number as written."""

    value: float
    column: int


@dataclass(frozen=True, slots=True)
class Name:
    """A name as written, not yet resolved."""

    name: str
    column: int


@dataclass(frozen=True, slots=True)
class Prefix:
    """``-a`` or ``not a``."""

    operator: str
    operand: "SyntaxNode"
    column: int


@dataclass(frozen=True, slots=True)
class Infix:
    """``a operator b``; the column is the operator's."""

    operator: str
    left: "SyntaxNode"
    right: "SyntaxNode"
    column: int


@dataclass(frozen=True, slots=True)
class Apply:
    """``name(a, b, …)``: a function, or a signal at another time."""

    name: str
    arguments: "tuple[SyntaxNode, ...]"
    column: int


@dataclass(frozen=True, slots=True)
class Points:
    """``[a, b, …]``: the x or y of a table."""

    items: "tuple[SyntaxNode, ...]"
    column: int


SyntaxNode: TypeAlias = NumberLiteral | Name | Prefix | Infix | Apply | Points

TokenKind = Literal["number", "name", "operator", "end"]

_TOKEN = re.compile(
    r"""
      (?P<space>\s+)
    | (?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)
    | (?P<name>[^\W\d]\w*)
    | (?P<operator>\*\*|<=|>=|==|!=|[-+*/<>(),\[\]])
    | (?P<prime>(?<=[\w)])['’]+)
    | (?P<string>"[^"]*"?|'[^']*'?)
    | (?P<attribute>\.\s*[^\W\d]\w*)
    | (?P<other>.)
    """,
    re.VERBOSE | re.DOTALL,
)


class Token(NamedTuple):
    """One word of the text; `column` counts from 1."""

    kind: TokenKind
    text: str
    column: int


def tokenize_expression(text: str) -> tuple[list[Token], list[TextFault]]:
    """Split a text into tokens, with an end token; foreign tokens become faults."""
    tokens: list[Token] = []
    faults: list[TextFault] = []
    for match in _TOKEN.finditer(text):
        kind, word, column = match.lastgroup, match.group(), match.start() + 1
        if kind == "name":
            tokens.append(Token("name", word, column))
        elif kind == "operator":
            tokens.append(Token("operator", word, column))
        elif kind == "number":
            tokens.append(Token("number", word, column))
            if isinf(float(word)):
                faults.append(TextFault(column, f"the number {word[:20]} is too large"))
        elif kind != "space":
            faults.append(TextFault(column, _describe_foreign(kind, word)))
            if kind == "string":  # replaced by a number, so that the rest can be checked as well
                tokens.append(Token("number", "0", column))
    tokens.append(Token("end", "", len(text) + 1))
    return tokens, faults


def _describe_foreign(kind: str | None, word: str) -> str:
    if kind == "string":
        return "strings are not part of the language; it has numbers, names and operators"
    if kind == "attribute":
        return f"{word!r}: attributes are not part of the language"
    if kind == "prime":
        return (
            f"{word} marks a derivative, which is no name here: the equation of a state is its "
            "derivative; write that expression, or name it in let"
        )
    hint = f"; {SIGNS[word]}" if word in SIGNS else ""
    return f"{word!r} is not part of the language{hint}"


_CLOSING = {"(": ")", "[": "]"}
_OPPOSITE = {"+": "-", "-": "+", "*": "/", "/": "*"}

_MIN_FOLDED_LINKS = 8
"""Shorter chains are computed from left to right; longer ones are folded in halves."""


def parse_expression(text: str) -> tuple[SyntaxNode | None, list[TextFault]]:
    """Parse a text: its syntax, or None, and its faults."""
    if len(text) > MAX_EXPRESSION_LENGTH:
        detail = f"the text has {len(text)} characters; at most {MAX_EXPRESSION_LENGTH} are allowed"
        return None, [TextFault(1, detail)]
    words, faults = tokenize_expression(text)
    try:
        return _ExpressionParser(words).parse_whole(), faults
    except SyntaxFault as error:
        # A fault after a foreign token is a consequence and would only confuse.
        return None, faults or [error.fault]


class _ExpressionParser:
    """Parser of the tokens of one text."""

    def __init__(self, words: Sequence[Token]) -> None:
        self._words = words
        self._next = 0
        self._depth = 0

    def parse_whole(self) -> SyntaxNode:
        """Parse the whole text."""
        if self._peek().kind == "end":
            raise SyntaxFault(1, "the expression is empty")
        syntax = self._parse_operators(Level.OR)
        word = self._peek()
        if word.kind != "end":
            raise SyntaxFault(word.column, _describe_unexpected(word))
        return syntax

    def _parse_operators(self, floor: int) -> SyntaxNode:
        """Parse operators that bind at least as tightly as `floor`."""
        self._depth += 1
        if self._depth > MAX_EXPRESSION_DEPTH:
            detail = f"the expression is nested deeper than {MAX_EXPRESSION_DEPTH} levels"
            raise SyntaxFault(self._peek().column, detail)
        left = self._parse_operand()
        while (level := self._next_level()) >= floor:
            left = self._parse_chain(left, level)
        self._depth -= 1
        return left

    def _parse_chain(self, first: SyntaxNode, level: int) -> SyntaxNode:
        """Parse a chain of operators of one precedence after `first`: ``a - b + c``."""
        links: list[tuple[Token, SyntaxNode]] = []
        while self._next_level() == level:
            operator = self._advance()
            if level == Level.COMPARISON and links:
                detail = "comparisons do not chain; write a < b and b < c"
                raise SyntaxFault(operator.column, detail)
            # ** groups to the right: a**b**c is a**(b**c).
            links.append(
                (operator, self._parse_operators(level if level == Level.POWER else level + 1))
            )
        return _fold_chain(first, links)

    def _parse_operand(self) -> SyntaxNode:
        word = self._advance()
        if word.kind == "number":
            return NumberLiteral(float(word.text), word.column)
        if word.text == "-":
            return Prefix("-", self._parse_operators(Level.SIGN), word.column)
        if word.text == "not":
            return Prefix("not", self._parse_operators(Level.COMPARISON), word.column)
        if word.text == "(":
            inner = self._parse_operators(Level.OR)
            self._expect_closing(word)
            return inner
        if word.text == "[":
            return Points(self._parse_list(word), word.column)
        if word.kind == "name" and word.text not in OPERATORS:
            return self._parse_name(word)
        raise SyntaxFault(word.column, _describe_missing_operand(word))

    def _parse_name(self, word: Token) -> SyntaxNode:
        if self._peek().text != "(":
            return Name(word.text, word.column)
        return Apply(word.text, self._parse_list(self._advance()), word.column)

    def _parse_list(self, opening: Token) -> tuple[SyntaxNode, ...]:
        """Parse what is separated by commas, up to the closing parenthesis or bracket."""
        items: list[SyntaxNode] = []
        if self._peek().text != _CLOSING[opening.text]:
            items.append(self._parse_operators(Level.OR))
            while self._peek().text == ",":
                self._advance()
                items.append(self._parse_operators(Level.OR))
        self._expect_closing(opening)
        return tuple(items)

    def _expect_closing(self, opening: Token) -> None:
        word = self._peek()
        if word.text == _CLOSING[opening.text]:
            self._advance()
        elif word.kind == "end" or word.text in _CLOSING.values():
            kind = "parenthesis" if opening.text == "(" else "bracket"
            detail = f"the {kind} opened at column {opening.column} is not closed"
            raise SyntaxFault(opening.column, detail)
        elif opening.text == "[" and word.kind in ("number", "name"):
            detail = f"a comma is missing before {word.text!r}, as in [0, 1, 2]"
            raise SyntaxFault(word.column, detail)
        else:
            raise SyntaxFault(word.column, _describe_unexpected(word))

    def _peek(self) -> Token:
        return self._words[self._next]

    def _next_level(self) -> int:
        """Precedence of the next token; 0 if it is not an operator."""
        word = self._peek().text
        return OPERATORS[word].level if word in OPERATORS else 0

    def _advance(self) -> Token:
        word = self._peek()
        if word.kind != "end":
            self._next += 1
        return word


def _fold_chain(first: SyntaxNode, links: Sequence[tuple[Token, SyntaxNode]]) -> SyntaxNode:
    """Fold ``first op a op b …`` to a tree; a long chain has logarithmic depth."""
    if len(links) < _MIN_FOLDED_LINKS or links[0][0].text not in _OPPOSITE:
        tree = first
        for operator, operand in links:
            tree = Infix(operator.text, tree, operand, operator.column)
        return tree
    half = len(links) // 2
    joint, head = links[half]
    tail = links[half + 1 :]
    if joint.text in "-/":  # a - b + c = a - (b - c)
        tail = [(word._replace(text=_OPPOSITE[word.text]), operand) for word, operand in tail]
    return Infix(
        joint.text, _fold_chain(first, links[:half]), _fold_chain(head, tail), joint.column
    )


def _describe_unexpected(word: Token) -> str:
    if word.text == ")":
        return "')' closes a parenthesis that was never opened"
    if word.text in ("[", "]"):
        return (
            f"{word.text!r} belongs to the lists of table(u, [0, 1], [0, 5]) only; "
            "write a past value with parentheses, such as x(k-1)"
        )
    if word.text == ",":
        return "',' only separates the arguments of a function; 0.5 is written with a point"
    advice = find_advice(word.text, is_called=False)
    return f"unexpected {word.text!r}; {advice or 'an operator such as * is missing before it'}"


def _describe_missing_operand(word: Token) -> str:
    if word.kind == "end":
        return "the expression ends where a number, a name or a parenthesis should follow"
    if word.text == "+":
        return "'+' has no left operand; leave it out"
    return f"unexpected {word.text!r} where a number, a name or a parenthesis should be"
