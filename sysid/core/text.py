"""Format numbers, units and estimates for figures, pages, reports and terminals.

This module imports the standard library only, so that every command may use it.
"""

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TypeGuard

DASH = "–"
RELATIVE_UNIT = "σ"
"""Unit of the RMS over several outputs: the standard deviation of each."""
SETTING = re.compile(
    r"(?<!\bthe model )\b(?P<field>\w+): \{(?:(?<=\bparameters: \{)(?P<part>[^{}:,]+): \{)?"
    r"(?P<entries>[^{}:,]+: [^{}:,]+(?:, [^{}:,]+: [^{}:,]+)*)\}(?(part)\})"
    r"|\b(?P<name>prediction|initial|skip): "
    r"(?P<value>one-step|simulation|rest|free|measured|auto|\d+)\b"
)
"""A field of a job in a note, as in a job file: ``loss: {noise_model: ar1}``.

Of `parameters` it is one in them: ``parameters: {r: {physical: upper}}``. Text after "the model" is
excluded: it names a field of the model document, which no option sets.
"""
_AT_BOUND = "at bound"
_WITHOUT_ERROR = (_AT_BOUND, "not settled")  # statuses of an estimate
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


def find_shown_error(stderr: float | None, status: str) -> float | None:
    """Find the standard error that is shown with an estimate.

    An estimate at its bound has none, since its errors are not symmetric there. One of a search
    that did not settle has none either: its distance from the optimum is unknown.
    """
    return None if status in _WITHOUT_ERROR else stderr


def format_estimate(value: float, stderr: float | None, *, status: str = "") -> tuple[str, str]:
    """Format an estimate and its standard error, both to the error's second significant digit.

    The error is empty where `find_shown_error` finds none, and for a value that is not finite.
    """
    if not math.isfinite(value):
        return DASH, ""
    if status == _AT_BOUND:
        return f"{value:.6g}".replace("-", "−"), ""
    stderr = find_shown_error(stderr, status)
    if not _is_positive(stderr):
        return format_number(value, 6), ""
    decimals = _estimate_decimals(value, stderr)
    if decimals is None:
        return format_number(value, 6), format_number(stderr, 2)
    rounded = [f"{v:.{decimals}f}".replace("-", "−") for v in (value, stderr)]
    return rounded[0], rounded[1]


def join_names(names: Sequence[str]) -> str:
    """Join names as a sentence lists them.

    Examples
    --------
    >>> join_names(["K", "T", "L"])
    'K, T and L'
    """
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last


def join_estimate(value: float, stderr: float | None, *, status: str = "") -> str:
    """Format an estimate and its standard error as one text, ``0.1193 ± 0.0004``."""
    return " ± ".join(filter(None, format_estimate(value, stderr, status=status)))


def split_estimate(value: float, stderr: float | None, *, status: str = "") -> tuple[str, str]:
    """Format an estimate and its error for terminals and notes, readable by programs.

    The error is empty where `find_shown_error` finds none.
    """
    stderr = find_shown_error(stderr, status)
    if not _is_positive(stderr):
        return f"{value:.6g}", ""
    decimals = _estimate_decimals(value, stderr)
    if decimals is None:
        return f"{value:.6g}", f"{stderr:.2g}"
    return f"{value:.{decimals}f}", f"{stderr:.{decimals}f}"


def plain_estimate(value: float, stderr: float | None, *, status: str = "") -> str:
    """Join an estimate and its error for terminals and notes, ``0.1193 ± 0.0004``."""
    return " ± ".join(filter(None, split_estimate(value, stderr, status=status)))


def format_interval(
    ends: Sequence[float | None] | None,
    stderr: float | None,
    *,
    status: str = "",
    open_ends: Collection[str] = (),
) -> str:
    """Format a 95 % interval, to the digits of the standard error; empty without one.

    Of `open_ends`, ``lower`` or ``upper``, only a bound is known: they are "open".
    """
    return " … ".join(
        _write_ends(ends, status, open_ends, lambda end: format_estimate(end, stderr)[0])
    )


def plain_interval(
    ends: Sequence[float | None] | None,
    stderr: float | None,
    *,
    status: str = "",
    open_ends: Collection[str] = (),
) -> str:
    """Format a 95 % interval as `format_interval` does, for terminals and notes."""
    return " to ".join(
        _write_ends(ends, status, open_ends, lambda end: split_estimate(end, stderr)[0])
    )


def _write_ends(
    ends: Sequence[float | None] | None,
    status: str,
    open_ends: Collection[str],
    write: Callable[[float], str],
) -> list[str]:
    """Write both ends of an interval; none without one, and one dash if neither is finite."""
    if ends is None or status in _WITHOUT_ERROR:
        return []
    known = [end is not None and math.isfinite(end) for end in ends]
    if not any(known):
        return [DASH]
    return [
        "open" if name in open_ends else DASH if end is None or not is_known else write(end)
        for name, end, is_known in zip(("lower", "upper"), ends, known, strict=True)
    ]


def format_criterion(value: float | None) -> str:
    """Format AIC or BIC to one decimal: less of a difference says nothing."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.1f}".replace("-", "−")


def format_p_value(p: float | None) -> str:
    """Format the p value of a test."""
    if p is None or not math.isfinite(p):
        return DASH
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def format_unit(symbol: str) -> str:
    """Format a unit as it follows its number; empty for a dimensionless number."""
    return "" if symbol in ("1", "") else f"{_THIN_SPACE}{symbol}"


def find_rms_unit(units: Mapping[str, str], find_recorded: Callable[[str], str]) -> str:
    """Find the unit of the RMS: that of the output, or σ for several outputs together.

    Parameters
    ----------
    units : mapping of str to str
        Output → its unit in the model; a model that fits any unit has "1".
    find_recorded : callable
        Finds the unit of the channel that was recorded for an output without a unit.

    Examples
    --------
    >>> find_rms_unit({"y": "1"}, {"y": "°C"}.get)
    '°C'
    >>> find_rms_unit({"x": "m", "v": "m/s"}, {}.get)
    'σ'
    """
    if len(units) > 1:
        return RELATIVE_UNIT
    output, unit = next(iter(units.items()), ("", ""))
    return find_recorded(output) if unit == "1" else unit or "1"


def plain_unit(symbol: str | None) -> str:
    """Format a unit after a plain space, for terminals and notes; σ is spelled out."""
    if symbol == RELATIVE_UNIT:
        return " standard deviations"
    return "" if symbol in (None, "", "1") else f" {symbol}"


def bracket_unit(symbol: str | None) -> str:
    """Format a unit as it follows a name; empty for a dimensionless number."""
    return "" if symbol in (None, "", "1") else f" [{symbol}]"


def append_unit(name: str, symbol: str | None) -> str:
    """Format a heading with its unit, ``T [s]``; the unit σ stands for several outputs together."""
    return f"{name}{bracket_unit(symbol)}"


def rewrite_settings(note: str, write: Callable[[Sequence[str], Mapping[str, str]], str]) -> str:
    """Rewrite a note so that it names settings as the reader types them, not as a job file does.

    Parameters
    ----------
    write : callable
        Writes a setting from its place, and the names and values there. The place is a field, or
        ``parameters`` and one of them; it is empty for a setting of the job itself.

    Examples
    --------
    >>> rewrite_settings("use hold: {u: zero}", lambda place, entries: f"{place[0]}={entries}")
    "use hold={'u': 'zero'}"
    """

    def rewrite(match: re.Match[str]) -> str:
        if match["name"]:
            return write((), {match["name"]: match["value"]})
        entries = (entry.split(": ") for entry in match["entries"].split(", "))
        place = [name for name in (match["field"], match["part"]) if name]
        return write(place, dict(entries))

    return SETTING.sub(rewrite, note)


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
