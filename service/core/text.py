"""Format numbers, units, times and labels for pages, reports and terminals.

This module imports the standard library only, so that every command may use it.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import TypeGuard

DASH = "–"
_THIN_SPACE = "\u202f"  # narrow no-break space: groups digits and joins a number to its unit
_MAX_JSON = 60
FORMULA_STARTS = (*"=+-@\t\r\n", *"\uff1d\uff0b\uff0d\uff20")  # the last four: full width
"""First characters of formulas in common spreadsheets."""
_NUMBER = re.compile(r"[+-]?[0-9]*\.?[0-9]+([eE][+-]?[0-9]+)?")


def format_number(value: float | None, digits: int = 4) -> str:
    """Format a number with `digits` significant digits.

    Powers of ten are used where it is very large or small.
    """
    if value is None or not math.isfinite(value):
        return DASH
    if value != 0 and not 1e-4 <= abs(value) < 1e7:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10{_to_superscript(int(exponent))}".replace("-", "−")
    whole = len(str(int(abs(value))))
    decimals = max(digits - whole, 0) if abs(value) >= 1 else _count_decimals(value, digits)
    return f"{value:.{decimals}f}".replace("-", "−")


def format_estimate(value: float, stderr: float | None) -> tuple[str, str]:
    """Format an estimate and its standard error, both to the error's second significant digit."""
    if not _is_positive(stderr):
        return format_number(value, 6), ""
    decimals = _estimate_decimals(value, stderr)
    if decimals is None:
        return format_number(value, 6), format_number(stderr, 2)
    rounded = [f"{v:.{decimals}f}".replace("-", "−") for v in (value, stderr)]
    return rounded[0], rounded[1]


def join_estimate(value: float, stderr: float | None) -> str:
    """Format an estimate and its standard error as one text, ``0.1193 ± 0.0004``."""
    return " ± ".join(filter(None, format_estimate(value, stderr)))


def plain_estimate(value: float, stderr: float | None) -> str:
    """Format an estimate and its error for terminals and notes, readable by programs."""
    if not _is_positive(stderr):
        return f"{value:.6g}"
    decimals = _estimate_decimals(value, stderr)
    if decimals is None:
        return f"{value:.6g} ± {stderr:.2g}"
    return f"{value:.{decimals}f} ± {stderr:.{decimals}f}"


def format_interval(ends: Sequence[float] | None, stderr: float | None) -> str:
    """Format a 95 % interval, to the digits of the standard error."""
    if ends is None:
        return ""
    low, high = (format_estimate(end, stderr)[0] for end in ends)
    return f"{low} … {high}"


def format_p_value(p: float | None) -> str:
    """Format the p value of a test."""
    if p is None:
        return DASH
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def format_unit(symbol: str) -> str:
    """Format a unit as it follows its number; empty for a dimensionless number."""
    return "" if symbol in ("1", "") else f"{_THIN_SPACE}{symbol}"


def plain_unit(symbol: str | None) -> str:
    """Format a unit after a plain space, for terminals and notes."""
    return "" if symbol in (None, "", "1") else f" {symbol}"


def bracket_unit(symbol: str | None) -> str:
    """Format a unit as it follows a name; empty for a dimensionless number."""
    return "" if symbol in (None, "", "1") else f" [{symbol}]"


def append_unit(name: str, symbol: str | None) -> str:
    """Format a heading with its unit, ``T [s]``; the unit σ stands for several outputs together."""
    return f"{name}{bracket_unit(symbol)}"


def format_count(value: float | None) -> str:
    """Format a whole number in groups of three digits."""
    return DASH if value is None else f"{value:,.0f}".replace(",", _THIN_SPACE)


def format_duration(seconds: float | None) -> str:
    """Format a duration in a suitable unit."""
    if seconds is None or not math.isfinite(seconds):
        return DASH
    if seconds < 1:
        return f"{1000 * seconds:.3g}{_THIN_SPACE}ms"
    if seconds < 60:
        return f"{seconds:.3g}{_THIN_SPACE}s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}{_THIN_SPACE}min {rest}{_THIN_SPACE}s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours}{_THIN_SPACE}h {minutes}{_THIN_SPACE}min"


def format_age(moment: datetime, now: datetime) -> str:
    """Format the age of a moment in its largest unit."""
    seconds = max((now - moment).total_seconds(), 0.0)
    for size, name in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= size:
            return f"{int(seconds // size)}{_THIN_SPACE}{name}"
    return f"{int(seconds)}{_THIN_SPACE}s"


def format_value(value: object) -> str:
    """Format the value of an axis or of a label; a model is represented by its name."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return (
            str(value["name"])
            if "name" in value
            else _shorten(json.dumps(value, ensure_ascii=False))
        )
    return ", ".join(map(format_value, value)) if isinstance(value, list) else str(value)


def format_labels(labels: Mapping[str, object]) -> str:
    """Format labels with their values, ``length_m = 5, bore = 4 mm``."""
    return ", ".join(f"{name} = {format_value(value)}" for name, value in labels.items())


def escape_formula(value: object) -> object:
    """Escape a value so that no spreadsheet evaluates it and no reader splits it into two lines."""
    if not isinstance(value, str):
        return value
    return ("'" if _is_formula(value) else "") + value.replace("\r", " ")


def unescape_formula(text: str) -> str:
    """Return a text without the apostrophe that `escape_formula` put before it."""
    return text[1:] if text.startswith("'") and _is_formula(text[1:]) else text


TEMPLATE_FILTERS = {
    "number": format_number,
    "unit": format_unit,
    "count": format_count,
    "duration": format_duration,
    "age": format_age,
}


def _is_formula(text: str) -> bool:
    return text.startswith(FORMULA_STARTS) and not _NUMBER.fullmatch(text)


def _is_positive(stderr: float | None) -> TypeGuard[float]:
    return stderr is not None and math.isfinite(stderr) and stderr > 0


def _estimate_decimals(value: float, stderr: float) -> int | None:
    """Choose the decimals of an estimate by its standard error; None if they are too many."""
    decimals = _count_decimals(stderr, 2)
    return None if decimals > 9 or max(abs(value), stderr) >= 1e9 else decimals


def _count_decimals(value: float, digits: int) -> int:
    if value == 0:
        return 0
    # Rounding may carry into the next decade: 0.0996 to two digits is 0.10, not 0.100.
    rounded = float(f"{abs(value):.{digits - 1}e}")
    return max(digits - 1 - math.floor(math.log10(rounded)), 0)


def _to_superscript(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _shorten(text: str) -> str:
    return text if len(text) <= _MAX_JSON else f"{text[: _MAX_JSON - 3]}…"
