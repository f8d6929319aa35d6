"""Text to tokens. What is not in the grammar is told apart, so that the message can say why."""

import re
from math import isinf
from typing import Literal, NamedTuple

from sysid.language.syntax import TextFault

Kind = Literal["number", "name", "operator", "end"]

_TOKEN = re.compile(
    r"""
      (?P<space>\s+)
    | (?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)
    | (?P<name>[^\W\d]\w*)
    | (?P<operator>\*\*|<=|>=|==|!=|[-+*/<>(),])
    | (?P<string>"[^"]*"?|'[^']*'?)
    | (?P<attribute>\.\s*[^\W\d]\w*)
    | (?P<other>.)
    """,
    re.VERBOSE | re.DOTALL,
)

_HINTS = {
    "^": "write ** for a power",
    "=": "write == to compare, inside where(…)",
    "−": "write the ASCII minus sign -",
    "·": "write * for a product",
    "×": "write * for a product",
    "[": "write a past value with parentheses, such as x(k-1)",
    "&": "write 'and' inside where(…)",
    "|": "write 'or' inside where(…)",
    "!": "write 'not' inside where(…)",
}


class Token(NamedTuple):
    """One word of the text; `column` counts from 1."""

    kind: Kind
    text: str
    column: int


def tokens(text: str) -> tuple[list[Token], list[TextFault]]:
    """Tokens of a text, the last being its end, and what in it is no token of the language."""
    found: list[Token] = []
    faults: list[TextFault] = []
    for match in _TOKEN.finditer(text):
        kind, word, column = match.lastgroup, match.group(), match.start() + 1
        if kind == "name":
            found.append(Token("name", word, column))
        elif kind == "operator":
            found.append(Token("operator", word, column))
        elif kind == "number":
            found.append(Token("number", word, column))
            if isinf(float(word)):
                faults.append(TextFault(column, f"the number {word[:20]} is too large"))
        elif kind != "space":
            faults.append(TextFault(column, _foreign(kind, word)))
            if kind == "string":  # stands for a number, so that the rest can be checked as well
                found.append(Token("number", "0", column))
    found.append(Token("end", "", len(text) + 1))
    return found, faults


def _foreign(kind: str | None, word: str) -> str:
    if kind == "string":
        return "strings are not part of the language; it has numbers, names and operators"
    if kind == "attribute":
        return f"{word!r}: attributes are not part of the language"
    hint = f"; {_HINTS[word]}" if word in _HINTS else ""
    return f"{word!r} is not part of the language{hint}"
