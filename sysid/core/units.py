"""Units of signals: parsing, comparison and conversion factors.

A unit is a product of powers such as ``kg·m²/s``, ``N*m``, ``1/(V s)`` or ``mbar``. It is parsed
into whole powers of the seven SI base units and a factor. So ``kPa`` and ``Pa``, or ``m/s^2`` and
``N/kg``, can be compared. °C and °F have an offset, so each is a unit of its own. A text that is
no such product may be any unit.

A radian is 1, and so is a revolution that is counted: 1 rpm is 1/60 Hz, but π/30 rad/s. A signal
in Hz may count cycles or radians, so ``Hz`` and ``rad/s`` have no conversion factor.
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
_MAX_CHARACTERS = 80  # longest text that is parsed
_MAX_FACTOR = 1e300  # larger factors, or smaller than its inverse, are refused


class _Unit(NamedTuple):
    """A unit as `factor` times powers of the base units.

    `pi` is the power of π in the factor, so that factors stay exact. `angle_powers` are the powers
    of radians, revolutions and hertz. `offset_scale` names a unit with an offset.
    """

    powers: _BasePowers
    factor: Fraction = Fraction(1)
    pi: int = 0
    angle_powers: tuple[int, int, int] = (0, 0, 0)
    offset_scale: str = ""

    def multiply_power(self, other: "_Unit", power: int) -> "_Unit":
        """Multiply by a power of another unit."""
        powers = tuple(a + power * b for a, b in zip(self.powers, other.powers, strict=True))
        angle_powers = tuple(
            a + power * b for a, b in zip(self.angle_powers, other.angle_powers, strict=True)
        )
        return _Unit(
            powers,  # type: ignore[arg-type]
            self.factor * other.factor**power,
            self.pi + power * other.pi,
            angle_powers,  # type: ignore[arg-type]
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
"""Common units without a conversion factor: known, but compared with no other unit."""

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
_COMMON_PREFIXES = "µmckMh"  # prefixes of suggested units
_MIN_LIKENESS = 0.6  # share of equal letters from which a unit is suggested

_SUPERSCRIPTS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_TOKEN = re.compile(
    r"\s*(?:(?P<name>[A-Za-zµΩ]+|°(?!\s*[A-Za-zµΩ])|%)"
    r"|(?P<power>(?:\^|\*\*)\s*[-−]?\d{1,2}|[⁻]?[⁰¹²³⁴⁵⁶⁷⁸⁹]{1,2}"
    r"|(?<=[A-Za-zµΩ])(?:[-−]?[2-9]|[-−]1)(?!\d))"
    r"|(?P<one>1(?!\d))|(?P<sign>[·⋅*/()]))\s*"
)


def is_blank_unit(unit: str | None) -> bool:
    """Whether a unit is missing or that of a plain number."""
    return unit is None or unit.strip() in _BLANK_UNITS


def format_unit(unit: str) -> str:
    """Format a unit behind a number; empty if there is none."""
    return "" if unit in ("", "1") else f" {unit}"


def is_readable_unit(unit: str) -> bool:
    """Whether a unit can be parsed."""
    return _parse_unit(unit) is not None


def is_known_unit(unit: str) -> bool:
    """Whether a unit can be parsed, or is known without a factor, such as ``dB``."""
    return unit.strip() in _UNCONVERTIBLE or is_readable_unit(unit)


def find_conversion_factor(unit: str, other: str) -> float | None:
    """Return the factor that converts a value from `unit` to `other`; None if there is none.

    Two equal texts give 1, whatever their meaning.
    """
    if unit.strip() == other.strip():
        return 1.0
    a, b = _parse_unit(unit), _parse_unit(other)
    if a is None or b is None or not _have_same_dimension(a, b):
        return None
    revolutions = _count_revolutions(a, b)
    if revolutions is None:
        return None
    try:
        factor = float(a.factor / b.factor * Fraction(2) ** revolutions) * pi ** (
            a.pi - b.pi + revolutions
        )
    except OverflowError:
        return None
    return factor if 1 / _MAX_FACTOR < factor < _MAX_FACTOR else None


def describe_difference(unit: str | None, other: str | None) -> str:
    """Describe how two units differ; empty if they are or may be the same.

    They may be the same if one is blank or cannot be parsed.
    """
    if unit is None or other is None or is_blank_unit(unit) or is_blank_unit(other):
        return ""
    factor = find_conversion_factor(unit, other)
    if factor == 1.0:
        return ""
    if factor is not None:
        return f"1 {unit} is {factor:.12g} {other}"
    a, b = _parse_unit(unit), _parse_unit(other)
    if a is None or b is None:
        return ""
    if _have_same_dimension(a, b) and _count_revolutions(a, b) is None:
        return f"between {unit} and {other} it is open whether cycles or radians are meant"
    return f"{unit} is not {other}, and no factor converts one into the other"


def multiply_units(unit: str, other: str) -> str:
    """Write the product of two units; a dimensionless one is left out."""
    return other if unit in ("1", "") else f"{unit}·{other}"


def divide_units(unit: str, other: str) -> str:
    """Write the quotient of two units, ``(l/min)/%``; ``"1"`` for equal ones.

    Examples
    --------
    >>> divide_units("°C", "%"), divide_units("l/min", "N·s"), divide_units("V", "V")
    ('°C/%', '(l/min)/(N·s)', '1')
    """
    if unit == other:
        return "1"
    above, below = (f"({text})" if set(text) & set("·*/ ") else text for text in (unit, other))
    return f"{above}/{below}"


def suggest_unit(unit: str) -> str:
    """Suggest a known unit for an unknown one, to append to a message.

    Empty if the unit is known, or if no known unit is similar.
    """
    if is_known_unit(unit):
        return ""
    parts = re.split(r"([A-Za-zµΩ]+)", unit[:_MAX_CHARACTERS].strip())
    names = [
        part if position % 2 == 0 or _find_named_unit(part) else _find_nearest_unit(part)
        for position, part in enumerate(parts)
    ]
    suggestion = "".join(names)
    return f"; did you mean {suggestion!r}?" if suggestion and is_readable_unit(suggestion) else ""


def _find_nearest_unit(name: str) -> str:
    """Find the known unit with the most similar symbol; empty if none is similar."""
    spelled = name.lower()
    if spelled_out := _SPELLED_OUT.get(spelled) or _SPELLED_OUT.get(spelled.removesuffix("s")):
        return spelled_out
    symbols = [
        *_PREFIXED,
        *_UNPREFIXED,
        *(a + b for b in _PREFIXED for a in _COMMON_PREFIXES if len(b) < 4),
    ]
    best = max(symbols, key=lambda symbol: _measure_likeness(name, symbol))
    return best if _measure_likeness(name, best)[0] >= _MIN_LIKENESS else ""


def _measure_likeness(name: str, symbol: str) -> tuple[float, float]:
    """Share of equal letters of two names, ignoring case and respecting case."""
    any_case = SequenceMatcher(None, name.lower(), symbol.lower(), autojunk=False).ratio()
    return any_case, SequenceMatcher(None, name, symbol, autojunk=False).ratio()


def _have_same_dimension(a: _Unit, b: _Unit) -> bool:
    return a.powers == b.powers and a.offset_scale == b.offset_scale


def _count_revolutions(a: _Unit, b: _Unit) -> int | None:
    """Count the revolutions of `a` that are radians (2π each) in `b`; None if ambiguous."""
    radians, revolutions, hertz = (
        x - y for x, y in zip(a.angle_powers, b.angle_powers, strict=True)
    )
    if revolutions == -radians and hertz == 0:
        return revolutions
    if radians == 0:
        # A count, as in 1/min and Hz. Other quantities per revolution, such as N·m, are ambiguous.
        is_rate = a.powers[2] and not any((*a.powers[:2], *a.powers[3:]))
        return 0 if is_rate or revolutions + hertz == 0 or revolutions == 0 else None
    return 0 if revolutions == hertz == 0 else None


@lru_cache(maxsize=256)
def _parse_unit(text: str) -> _Unit | None:
    """Parse a unit; None if it is not a product of powers of known units."""
    scale = _OFFSET_SCALES.get(text.replace(" ", ""))
    if scale is not None:
        return _Unit(_DIMENSIONLESS, offset_scale=scale)
    tokens = _tokenize_unit(text.replace("μ", "µ").replace("Ω", "Ω").strip())
    if tokens is None:
        return None
    parser = _UnitParser(tokens)
    unit = parser.parse_product()
    return None if parser.tokens else unit


def _tokenize_unit(text: str) -> list[tuple[str, str]] | None:
    if len(text) > _MAX_CHARACTERS:
        return None
    tokens: list[tuple[str, str]] = []
    position = 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None or match.lastgroup is None:
            return None
        tokens.append((match.lastgroup, match[match.lastgroup]))
        position = match.end()
    return tokens


class _UnitParser:
    """Parser of products and quotients, from left to right: ``m/s·kg`` is ``(m/s)·kg``."""

    def __init__(self, tokens: list[tuple[str, str]]) -> None:
        self.tokens = tokens

    def parse_product(self) -> _Unit | None:
        """Parse factors up to a closing parenthesis or the end."""
        unit = self._parse_power()
        while unit is not None and self.tokens and self.tokens[0] != ("sign", ")"):
            sign = -1 if self.tokens[0] == ("sign", "/") else 1
            if self.tokens[0][0] == "sign" and self.tokens[0][1] != "(":
                self.tokens.pop(0)
            other = self._parse_power()
            unit = None if other is None else unit.multiply_power(other, sign)
        return unit

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
    """Find a unit by its symbol, first without and then with a prefix (``min`` is minutes)."""
    plain = _UNPREFIXED.get(name) or _PREFIXED.get(name)
    if plain is not None:
        return plain
    for prefix, power in _PREFIXES.items():
        unit = _PREFIXED.get(name.removeprefix(prefix)) if name.startswith(prefix) else None
        if unit is not None:
            return unit._replace(factor=unit.factor * Fraction(10) ** power)
    return None
