"""Units as they are written beside signals: whether two are the same, and by what they differ.

A unit is a product of powers such as ``kg·m²/s``, ``N*m``, ``1/(V s)`` or ``mbar``. It is read
into seven whole-numbered powers of the SI base units and a factor, so that ``kPa`` and ``Pa``, or
``m/s^2`` and ``N/kg``, can be compared. °C and °F have an offset, which no factor is: each is a
unit of its own. Of a text that is no such product nothing is known: it may be any unit.

A radian is 1, and so is a revolution where it is counted: 1 rpm is 1/60 Hz, but π/30 rad/s. Whether
a signal in Hz is meant as a rate of cycles or of radians nobody can tell, so that between ``Hz``
and ``rad/s`` there is no number.
"""

import re
from difflib import SequenceMatcher
from fractions import Fraction
from functools import lru_cache
from math import pi
from typing import NamedTuple

_BasePowers = tuple[int, int, int, int, int, int, int]
_DIMENSIONLESS: _BasePowers = (0, 0, 0, 0, 0, 0, 0)  # of m, kg, s, A, K, mol, cd

_BLANK_UNITS = ("", "1", "-", "–")
_MAX_CHARACTERS = 80  # characters of a text that is looked at
_MAX_FACTOR = 1e300  # a factor beyond it, or its inverse, is none


class _Unit(NamedTuple):
    """`find_conversion_factor` base units.

    `pi` is the power of π in it, so that factors stay exact; `around` are those of radians,
    revolutions and hertz; `scale` names a unit with an offset.
    """

    powers: _BasePowers
    factor: Fraction = Fraction(1)
    pi: int = 0
    angle_powers: tuple[int, int, int] = (0, 0, 0)
    offset_scale: str = ""

    def multiply_power(self, other: "_Unit", power: int) -> "_Unit":
        """Multiply by a power of another."""
        powers = tuple(a + power * b for a, b in zip(self.powers, other.powers, strict=True))
        around = tuple(
            a + power * b for a, b in zip(self.angle_powers, other.angle_powers, strict=True)
        )
        return _Unit(
            powers,  # type: ignore[arg-type]
            self.factor * other.factor**power,
            self.pi + power * other.pi,
            around,  # type: ignore[arg-type]
        )


_RADIANS, _REVOLUTIONS, _HERTZ = (1, 0, 0), (0, 1, 0), (0, 0, 1)
_PREFIXED = {
    "m": _Unit((1, 0, 0, 0, 0, 0, 0)),
    "g": _Unit((0, 1, 0, 0, 0, 0, 0), Fraction(1, 1000)),
    "s": _Unit((0, 0, 1, 0, 0, 0, 0)),
    "A": _Unit((0, 0, 0, 1, 0, 0, 0)),
    "K": _Unit((0, 0, 0, 0, 1, 0, 0)),
    "mol": _Unit((0, 0, 0, 0, 0, 1, 0)),
    "cd": _Unit((0, 0, 0, 0, 0, 0, 1)),
    "Hz": _Unit((0, 0, -1, 0, 0, 0, 0), angle_powers=_HERTZ),
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
    "rad": _Unit(_DIMENSIONLESS, angle_powers=_RADIANS),
    "S": _Unit((-2, -1, 3, 2, 0, 0, 0)),
    "Wb": _Unit((2, 1, -2, -1, 0, 0, 0)),
    "sec": _Unit((0, 0, 1, 0, 0, 0, 0)),
    "Nm": _Unit((2, 1, -2, 0, 0, 0, 0)),
    "Ws": _Unit((2, 1, -2, 0, 0, 0, 0)),
    "Wh": _Unit((2, 1, -2, 0, 0, 0, 0), Fraction(3600)),
    "As": _Unit((0, 0, 1, 1, 0, 0, 0)),
    "Ah": _Unit((0, 0, 1, 1, 0, 0, 0), Fraction(3600)),
    "Vs": _Unit((2, 1, -2, -1, 0, 0, 0)),
}
_UNPREFIXED = {
    "deg": _Unit(_DIMENSIONLESS, Fraction(1, 180), 1, _RADIANS),
    "°": _Unit(_DIMENSIONLESS, Fraction(1, 180), 1, _RADIANS),
    "rev": _Unit(_DIMENSIONLESS, angle_powers=_REVOLUTIONS),
    "rpm": _Unit((0, 0, -1, 0, 0, 0, 0), Fraction(1, 60), angle_powers=_REVOLUTIONS),
    "RPM": _Unit((0, 0, -1, 0, 0, 0, 0), Fraction(1, 60), angle_powers=_REVOLUTIONS),
    "rps": _Unit((0, 0, -1, 0, 0, 0, 0), angle_powers=_REVOLUTIONS),
    "%": _Unit(_DIMENSIONLESS, Fraction(1, 100)),
    "min": _Unit((0, 0, 1, 0, 0, 0, 0), Fraction(60)),
    "h": _Unit((0, 0, 1, 0, 0, 0, 0), Fraction(3600)),
    "hr": _Unit((0, 0, 1, 0, 0, 0, 0), Fraction(3600)),
    "t": _Unit((0, 1, 0, 0, 0, 0, 0), Fraction(1000)),
    "in": _Unit((1, 0, 0, 0, 0, 0, 0), Fraction(254, 10_000)),
    "inch": _Unit((1, 0, 0, 0, 0, 0, 0), Fraction(254, 10_000)),
    "ft": _Unit((1, 0, 0, 0, 0, 0, 0), Fraction(3048, 10_000)),
    "kgf": _Unit((1, 1, -2, 0, 0, 0, 0), Fraction(980_665, 100_000)),
    "atm": _Unit((-1, 1, -2, 0, 0, 0, 0), Fraction(101_325)),
    "psi": _Unit((-1, 1, -2, 0, 0, 0, 0), Fraction(8_896_443_230_521, 1_290_320_000)),
    "mmHg": _Unit((-1, 1, -2, 0, 0, 0, 0), Fraction(133_322_387_415, 10**9)),
    "Torr": _Unit((-1, 1, -2, 0, 0, 0, 0), Fraction(101_325, 760)),
    "lbf": _Unit((1, 1, -2, 0, 0, 0, 0), Fraction(44_482_216_152_605, 10**13)),
    "lb": _Unit((0, 1, 0, 0, 0, 0, 0), Fraction(45_359_237, 10**8)),
    "mph": _Unit((1, 0, -1, 0, 0, 0, 0), Fraction(44_704, 10**5)),
    "d": _Unit((0, 0, 1, 0, 0, 0, 0), Fraction(86_400)),
    "day": _Unit((0, 0, 1, 0, 0, 0, 0), Fraction(86_400)),
    "ppm": _Unit(_DIMENSIONLESS, Fraction(1, 10**6)),
    "ppb": _Unit(_DIMENSIONLESS, Fraction(1, 10**9)),
}
_PREFIXES = {
    "p": -12,
    "n": -9,
    "µ": -6,
    "u": -6,
    "m": -3,
    "c": -2,
    "d": -1,
    "h": 2,
    "k": 3,
    "M": 6,
    "G": 9,
    "T": 12,
}

_OFFSET_SCALES = {
    "°C": "°C",
    "℃": "°C",
    "degC": "°C",
    "Celsius": "°C",
    "celsius": "°C",
    "°F": "°F",
    "℉": "°F",
    "degF": "°F",
    "Fahrenheit": "°F",
    "fahrenheit": "°F",
}

_UNCONVERTIBLE = ("dB", "dBm", "pH", "count", "counts", "px")
"""Units that many have and no factor leads to: known, and compared with nothing."""

_SPELLED_OUT = {
    "second": "s",
    "minute": "min",
    "hour": "h",
    "metre": "m",
    "meter": "m",
    "gram": "g",
    "ampere": "A",
    "amp": "A",
    "volt": "V",
    "watt": "W",
    "joule": "J",
    "newton": "N",
    "pascal": "Pa",
    "bars": "bar",
    "hertz": "Hz",
    "kelvin": "K",
    "liter": "L",
    "litre": "L",
    "degree": "deg",
    "radian": "rad",
    "percent": "%",
    "pct": "%",
    "foot": "ft",
    "feet": "ft",
    "mol": "mol",
    "mole": "mol",
    "none": "1",
    "unitless": "1",
    "dimensionless": "1",
}
_COMMON_PREFIXES = "µmckMh"  # prefixes of what is suggested
_MIN_LIKENESS = 0.6  # of the letters of a name, for which another is suggested

_SUPERSCRIPTS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_TOKEN = re.compile(
    r"\s*(?:(?P<name>[A-Za-zµΩ]+|°(?!\s*[A-Za-zµΩ])|%)"
    r"|(?P<power>(?:\^|\*\*)\s*[-−]?\d{1,2}|[⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹]{1,2}"
    r"|(?<=[A-Za-zµΩ])(?:[-−]?[2-9]|[-−]1)(?!\d))"
    r"|(?P<one>1(?!\d))|(?P<sign>[·⋅*/()]))\s*"
)


def is_blank_unit(unit: str | None) -> bool:
    """Whether nothing is said by it: a channel without a unit, or a plain number."""
    return unit is None or unit.strip() in _BLANK_UNITS


def format_unit(unit: str) -> str:
    """A unit as it stands behind a number; nothing where there is none."""
    return "" if unit in ("", "1") else f" {unit}"


def is_readable_unit(unit: str) -> bool:
    """Whether it is known what a unit means."""
    return _parse_unit(unit) is not None


def is_known_unit(unit: str) -> bool:
    """Whether a unit can be read, or is one of those that no factor leads to, such as ``dB``."""
    return unit.strip() in _UNCONVERTIBLE or is_readable_unit(unit)


def find_conversion_factor(unit: str, other: str) -> float | None:
    """By what a value in `unit` is multiplied to be in `other`; None if no such number is known.

    Two equal texts give 1, whatever they mean.
    """
    if unit.strip() == other.strip():
        return 1.0
    a, b = _parse_unit(unit), _parse_unit(other)
    if a is None or b is None or not _have_same_dimension(a, b):
        return None
    turned = _count_revolutions(a, b)
    if turned is None:
        return None
    try:
        times = float(a.factor / b.factor * Fraction(2) ** turned) * pi ** (a.pi - b.pi + turned)
    except OverflowError:
        return None
    return times if 1 / _MAX_FACTOR < times < _MAX_FACTOR else None


def describe_difference(unit: str | None, other: str | None) -> str:
    """What to say of two units that are not one: empty where they are, or where they may be.

    They may where one is blank, or cannot be read.
    """
    if unit is None or other is None or is_blank_unit(unit) or is_blank_unit(other):
        return ""
    times = find_conversion_factor(unit, other)
    if times == 1.0:
        return ""
    if times is not None:
        return f"1 {unit} is {times:.12g} {other}"
    a, b = _parse_unit(unit), _parse_unit(other)
    if a is None or b is None:
        return ""
    if _have_same_dimension(a, b) and _count_revolutions(a, b) is None:
        return f"between {unit} and {other} it is open whether cycles or radians are meant"
    return f"{unit} is not {other}, and no number makes one of the other"


def multiply_units(unit: str, other: str) -> str:
    """Product of two units as a text; of a number without dimension the other one."""
    return other if unit in ("1", "") else f"{unit}·{other}"


def suggest_unit(unit: str) -> str:
    """What may be meant by a text that is no known unit, to be added to a message about it.

    Empty of a known unit, and where none is written alike.
    """
    if is_known_unit(unit):
        return ""
    parts = re.split(r"([A-Za-zµΩ]+)", unit[:_MAX_CHARACTERS].strip())
    names = [
        part if at % 2 == 0 or _find_named_unit(part) else _find_nearest_unit(part)
        for at, part in enumerate(parts)
    ]
    meant = "".join(names)
    return f"; did you mean {meant!r}?" if meant and is_readable_unit(meant) else ""


def _find_nearest_unit(name: str) -> str:
    """The known unit whose symbol is written most alike; empty if none is."""
    spelled = name.lower()
    if found := _SPELLED_OUT.get(spelled) or _SPELLED_OUT.get(spelled.removesuffix("s")):
        return found
    known = [
        *_PREFIXED,
        *_UNPREFIXED,
        *(a + b for b in _PREFIXED for a in _COMMON_PREFIXES if len(b) < 4),
    ]
    best = max(known, key=lambda one: _measure_likeness(name, one))
    return best if _measure_likeness(name, best)[0] >= _MIN_LIKENESS else ""


def _measure_likeness(name: str, known: str) -> tuple[float, float]:
    """How many letters two names share, whatever their case, and how many in the same case."""
    alike = SequenceMatcher(None, name.lower(), known.lower(), autojunk=False).ratio()
    return alike, SequenceMatcher(None, name, known, autojunk=False).ratio()


def _have_same_dimension(a: _Unit, b: _Unit) -> bool:
    return a.powers == b.powers and a.offset_scale == b.offset_scale


def _count_revolutions(a: _Unit, b: _Unit) -> int | None:
    """How many revolutions of `a` are radians in `b`, each of 2π; None if that is open."""
    radians, revolutions, hertz = (
        x - y for x, y in zip(a.angle_powers, b.angle_powers, strict=True)
    )
    if revolutions == -radians and hertz == 0:
        return revolutions
    if radians == 0:
        # Counted, as in 1/min and Hz. Of what else is per revolution, as N·m, it is open.
        is_rate = a.powers[2] and not any((*a.powers[:2], *a.powers[3:]))
        return 0 if is_rate or revolutions + hertz == 0 or revolutions == 0 else None
    return 0 if revolutions == hertz == 0 else None


@lru_cache(maxsize=256)
def _parse_unit(text: str) -> _Unit | None:
    """The unit that a text means; None if it is no product of powers of known ones."""
    scale = _OFFSET_SCALES.get(text.replace(" ", ""))
    if scale is not None:
        return _Unit(_DIMENSIONLESS, offset_scale=scale)
    tokens = _tokenize_unit(text.replace("μ", "µ").replace("Ω", "Ω").strip())
    if tokens is None:
        return None
    reader = _UnitParser(tokens)
    found = reader.parse_product()
    return None if reader.tokens else found


def _tokenize_unit(text: str) -> list[tuple[str, str]] | None:
    if len(text) > _MAX_CHARACTERS:
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


class _UnitParser:
    """Products and quotients from left to right: ``m/s·kg`` is ``(m/s)·kg``."""

    def __init__(self, tokens: list[tuple[str, str]]) -> None:
        self.tokens = tokens

    def parse_product(self) -> _Unit | None:
        """Factors up to a closing parenthesis or the end."""
        found = self._parse_power()
        while found is not None and self.tokens and self.tokens[0] != ("sign", ")"):
            sign = -1 if self.tokens[0] == ("sign", "/") else 1
            if self.tokens[0][0] == "sign" and self.tokens[0][1] != "(":
                self.tokens.pop(0)
            other = self._parse_power()
            found = None if other is None else found.multiply_power(other, sign)
        return found

    def _parse_power(self) -> _Unit | None:
        base = self._parse_base()
        if base is None or not self.tokens or self.tokens[0][0] != "power":
            return base
        digits = self.tokens.pop(0)[1].translate(_SUPERSCRIPTS).replace("−", "-")
        return _Unit(_DIMENSIONLESS).multiply_power(base, int(digits.lstrip("^* ")))

    def _parse_base(self) -> _Unit | None:
        kind, text = self.tokens.pop(0) if self.tokens else ("", "")
        if kind == "name":
            return _find_named_unit(text)
        if kind == "one":
            return _Unit(_DIMENSIONLESS)
        if text != "(":
            return None
        inside = self.parse_product()
        if not self.tokens or self.tokens.pop(0)[1] != ")":
            return None
        return inside


def _find_named_unit(name: str) -> _Unit | None:
    """A unit by its symbol, with or without a prefix; without goes first, so ``min`` is one."""
    known = _UNPREFIXED.get(name) or _PREFIXED.get(name)
    if known is not None:
        return known
    for prefix, power in _PREFIXES.items():
        unit = _PREFIXED.get(name.removeprefix(prefix)) if name.startswith(prefix) else None
        if unit is not None:
            return unit._replace(factor=unit.factor * Fraction(10) ** power)
    return None
