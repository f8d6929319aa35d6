"""Format numbers, units and estimates for figures, pages, reports and terminals.

This module imports the standard library only, so that every command may use it.
"""

import math
from collections.abc import Sequence
from typing import TypeGuard

DASH = "–"
_THIN_SPACE = "\u202f"  # narrow no-break space: joins a number to its unit


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


def format_estimate(
    value: float, stderr: float | None, *, is_bound: bool = False
) -> tuple[str, str]:
    """Format an estimate and its standard error, both to the error's second significant digit.

    A value that is a bound is not rounded to its error.
    """
    if not _is_positive(stderr):
        return format_number(value, 6), ""
    decimals = _estimate_decimals(value, stderr)
    if decimals is None:
        return format_number(value, 6), format_number(stderr, 2)
    if is_bound:
        return f"{value:.6g}".replace("-", "−"), f"{stderr:.{decimals}f}"
    rounded = [f"{v:.{decimals}f}".replace("-", "−") for v in (value, stderr)]
    return rounded[0], rounded[1]


def join_estimate(value: float, stderr: float | None, *, is_bound: bool = False) -> str:
    """Format an estimate and its standard error as one text, ``0.1193 ± 0.0004``."""
    return " ± ".join(filter(None, format_estimate(value, stderr, is_bound=is_bound)))


def plain_estimate(value: float, stderr: float | None, *, is_bound: bool = False) -> str:
    """Format an estimate and its error for terminals and notes, readable by programs.

    A value that is a bound is not rounded to its error, which may be far larger.
    """
    if not _is_positive(stderr):
        return f"{value:.6g}"
    decimals = _estimate_decimals(value, stderr)
    if decimals is None:
        return f"{value:.6g} ± {stderr:.2g}"
    if is_bound:
        return f"{value:.6g} ± {stderr:.{decimals}f}"
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
