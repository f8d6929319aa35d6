"""Units as they are written beside signals: whether two are the same, and by what they differ.

A unit is a product of powers such as ``kg·m²/s``, ``N*m``, ``1/(V s)`` or ``mbar``. It is read
into seven whole-numbered powers of the SI base units and a factor, so that ``kPa`` and ``Pa``, or
``m/s^2`` and ``N/kg``, can be compared. A text that is no such product is a unit of its own: it is
equal to itself only. Temperatures in °C are of this kind, since an offset is no factor.
"""

import re
from fractions import Fraction
from functools import lru_cache
from math import pi
from typing import NamedTuple

_Powers = tuple[int, int, int, int, int, int, int]
_NONE: _Powers = (0, 0, 0, 0, 0, 0, 0)  # of m, kg, s, A, K, mol, cd

_BLANK = ("", "1", "-", "–")
_LONGEST = 80  # characters of a text that is looked at


class _Unit(NamedTuple):
    """`factor` base units; `turns` is the power of π in it, so that factors stay exact."""

    powers: _Powers
    factor: Fraction = Fraction(1)
    turns: int = 0

    def times(self, other: "_Unit", power: int) -> "_Unit":
        """Multiply by a power of another."""
        powers = tuple(a + power * b for a, b in zip(self.powers, other.powers, strict=True))
        return _Unit(
            powers,  # type: ignore[arg-type]
            self.factor * other.factor**power,
            self.turns + power * other.turns,
        )


_PREFIXED = {
    "m": _Unit((1, 0, 0, 0, 0, 0, 0)),
    "g": _Unit((0, 1, 0, 0, 0, 0, 0), Fraction(1, 1000)),
    "s": _Unit((0, 0, 1, 0, 0, 0, 0)),
    "A": _Unit((0, 0, 0, 1, 0, 0, 0)),
    "K": _Unit((0, 0, 0, 0, 1, 0, 0)),
    "mol": _Unit((0, 0, 0, 0, 0, 1, 0)),
    "cd": _Unit((0, 0, 0, 0, 0, 0, 1)),
    "Hz": _Unit((0, 0, -1, 0, 0, 0, 0)),
    "N": _Unit((1, 1, -2, 0, 0, 0, 0)),
    "Pa": _Unit((-1, 1, -2, 0, 0, 0, 0)),
    "bar": _Unit((-1, 1, -2, 0, 0, 0, 0), Fraction(100_000)),
    "J": _Unit((2, 1, -2, 0, 0, 0, 0)),
    "W": _Unit((2, 1, -3, 0, 0, 0, 0)),
    "V": _Unit((2, 1, -3, -1, 0, 0, 0)),
    "C": _Unit((0, 0, 1, 1, 0, 0, 0)),
    "F": _Unit((-2, -1, 4, 2, 0, 0, 0)),
    "Ω": _Unit((2, 1, -3, -2, 0, 0, 0)),
    "Ohm": _Unit((2, 1, -3, -2, 0, 0, 0)),
    "ohm": _Unit((2, 1, -3, -2, 0, 0, 0)),
    "T": _Unit((0, 1, -2, -1, 0, 0, 0)),
    "H": _Unit((2, 1, -2, -2, 0, 0, 0)),
    "L": _Unit((3, 0, 0, 0, 0, 0, 0), Fraction(1, 1000)),
    "l": _Unit((3, 0, 0, 0, 0, 0, 0), Fraction(1, 1000)),
    "rad": _Unit(_NONE),
}
_ALONE = {
    "deg": _Unit(_NONE, Fraction(1, 180), 1),
    "°": _Unit(_NONE, Fraction(1, 180), 1),
    "rev": _Unit(_NONE, Fraction(2), 1),
    "rpm": _Unit((0, 0, -1, 0, 0, 0, 0), Fraction(1, 30), 1),
    "%": _Unit(_NONE, Fraction(1, 100)),
    "min": _Unit((0, 0, 1, 0, 0, 0, 0), Fraction(60)),
    "h": _Unit((0, 0, 1, 0, 0, 0, 0), Fraction(3600)),
    "atm": _Unit((-1, 1, -2, 0, 0, 0, 0), Fraction(101_325)),
    "psi": _Unit((-1, 1, -2, 0, 0, 0, 0), Fraction(8_896_443_230_521, 1_290_320_000)),
}
_PREFIXES = {"p": -12, "n": -9, "µ": -6, "u": -6, "m": -3, "c": -2, "d": -1, "h": 2, "k": 3,
             "M": 6, "G": 9, "T": 12}  # fmt: skip

_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_TOKEN = re.compile(
    r"\s*(?:(?P<name>[A-Za-zµΩ]+|[°%])|(?P<one>1(?!\d))"
    r"|(?P<power>(?:\^|\*\*)\s*[-−]?\d{1,2}|[⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹]{1,2})|(?P<sign>[·⋅*/()]))\s*"
)


def is_blank(unit: str | None) -> bool:
    """Whether nothing is said by it: a channel without a unit, or a plain number."""
    return unit is None or unit.strip() in _BLANK


def factor(unit: str, other: str) -> float | None:
    """By what a value in `unit` is multiplied to be in `other`; None if there is no such number.

    Two equal texts give 1, whatever they mean.
    """
    if unit.strip() == other.strip():
        return 1.0
    a, b = _read(unit), _read(other)
    if a is None or b is None or a.powers != b.powers:
        return None
    try:
        return float(a.factor / b.factor) * pi ** (a.turns - b.turns) or None  # 0: it underflowed
    except OverflowError:
        return None


def difference(unit: str | None, other: str | None) -> str:
    """What to say of two units that are not one: empty where they are, or where one is blank."""
    if unit is None or other is None or is_blank(unit) or is_blank(other):
        return ""
    times = factor(unit, other)
    if times == 1.0:
        return ""
    if times is None:
        return f"{unit} is not {other}, and no number makes one of the other"
    return f"1 {unit} is {times:.12g} {other}"


@lru_cache(maxsize=256)
def _read(text: str) -> _Unit | None:
    """The unit that a text means; None if it is no product of powers of known ones."""
    tokens = _tokens(text.replace("μ", "µ").replace("Ω", "Ω").strip())
    if tokens is None:
        return None
    reader = _Reader(tokens)
    found = reader.product()
    return None if reader.tokens else found


def _tokens(text: str) -> list[tuple[str, str]] | None:
    if len(text) > _LONGEST:
        return None
    tokens: list[tuple[str, str]] = []
    place = 0
    while place < len(text):
        found = _TOKEN.match(text, place)
        if found is None or found.lastgroup is None:
            return None
        tokens.append((found.lastgroup, found[found.lastgroup]))
        place = found.end()
    return tokens


class _Reader:
    """Products and quotients from left to right: ``m/s·kg`` is ``(m/s)·kg``."""

    def __init__(self, tokens: list[tuple[str, str]]) -> None:
        self.tokens = tokens

    def product(self) -> _Unit | None:
        """Factors up to a closing parenthesis or the end."""
        found = self._power()
        while found is not None and self.tokens and self.tokens[0] != ("sign", ")"):
            sign = -1 if self.tokens[0] == ("sign", "/") else 1
            if self.tokens[0][0] == "sign" and self.tokens[0][1] != "(":
                self.tokens.pop(0)
            other = self._power()
            found = None if other is None else found.times(other, sign)
        return found

    def _power(self) -> _Unit | None:
        base = self._base()
        if base is None or not self.tokens or self.tokens[0][0] != "power":
            return base
        digits = self.tokens.pop(0)[1].translate(_RAISED).replace("−", "-")
        return _Unit(_NONE).times(base, int(digits.lstrip("^* ")))

    def _base(self) -> _Unit | None:
        kind, text = self.tokens.pop(0) if self.tokens else ("", "")
        if kind == "name":
            return _named(text)
        if kind == "one":
            return _Unit(_NONE)
        if text != "(":
            return None
        inside = self.product()
        if not self.tokens or self.tokens.pop(0)[1] != ")":
            return None
        return inside


def _named(name: str) -> _Unit | None:
    """A unit by its symbol, with or without a prefix; without goes first, so ``min`` is one."""
    known = _ALONE.get(name) or _PREFIXED.get(name)
    if known is not None:
        return known
    for prefix, power in _PREFIXES.items():
        unit = _PREFIXED.get(name.removeprefix(prefix)) if name.startswith(prefix) else None
        if unit is not None:
            return unit._replace(factor=unit.factor * Fraction(10) ** power)
    return None
