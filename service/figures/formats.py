"""How numbers, units, times and durations are written on pages and in reports."""

import math
from datetime import datetime

DASH = "–"
_THIN = "\u202f"  # narrow no-break space: groups digits and joins a number to its unit


def number(value: float | None, digits: int = 4) -> str:
    """A number with that many significant digits; powers of ten where it is very large or small."""
    if value is None or not math.isfinite(value):
        return DASH
    if value != 0 and not 1e-4 <= abs(value) < 1e7:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10{_raised(int(exponent))}".replace("-", "−")
    whole = len(str(int(abs(value))))
    decimals = max(digits - whole, 0) if abs(value) >= 1 else _decimals(value, digits)
    return f"{value:.{decimals}f}".replace("-", "−")


def estimate(value: float, stderr: float | None) -> tuple[str, str]:
    """An estimate and its standard error, both to the error's second significant digit."""
    if stderr is None or not math.isfinite(stderr) or stderr <= 0:
        return number(value, 6), ""
    decimals = _decimals(stderr, 2)
    if decimals > 9 or max(abs(value), stderr) >= 1e9:
        return number(value, 6), number(stderr, 2)
    rounded = [f"{v:.{max(decimals, 0)}f}".replace("-", "−") for v in (value, stderr)]
    return rounded[0], rounded[1]


def interval(ends: tuple[float, float] | list[float] | None, stderr: float | None) -> str:
    """A 95 % interval, to the digits of the standard error."""
    if ends is None:
        return ""
    low, high = (estimate(end, stderr)[0] for end in ends)
    return f"{low} … {high}"


def unit(symbol: str) -> str:
    """A unit as it follows its number; nothing for a number without dimension."""
    return "" if symbol in ("1", "") else f"{_THIN}{symbol}"


def bracketed(symbol: str) -> str:
    """A unit as it follows a name; nothing for a number without dimension."""
    return "" if symbol in ("1", "") else f" [{symbol}]"


def count(value: float | None) -> str:
    """A whole number in groups of three digits."""
    return DASH if value is None else f"{value:,.0f}".replace(",", _THIN)


def duration(seconds: float | None) -> str:
    """A length of time in the unit that suits it."""
    if seconds is None or not math.isfinite(seconds):
        return DASH
    if seconds < 1:
        return f"{1000 * seconds:.3g}{_THIN}ms"
    if seconds < 60:
        return f"{seconds:.3g}{_THIN}s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}{_THIN}min {rest}{_THIN}s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours}{_THIN}h {minutes}{_THIN}min"


def age(moment: datetime, now: datetime) -> str:
    """How long ago a moment was, in its largest unit."""
    seconds = max((now - moment).total_seconds(), 0.0)
    for size, name in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= size:
            return f"{int(seconds // size)}{_THIN}{name}"
    return f"{int(seconds)}{_THIN}s"


FILTERS = {
    "number": number, "unit": unit, "count": count, "duration": duration, "age": age,
}  # fmt: skip


def _decimals(value: float, digits: int) -> int:
    if value == 0:
        return 0
    # Rounding may carry into the next decade: 0.0996 to two digits is 0.10, not 0.100.
    rounded = float(f"{abs(value):.{digits - 1}e}")
    return max(digits - 1 - math.floor(math.log10(rounded)), 0)


def _raised(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
