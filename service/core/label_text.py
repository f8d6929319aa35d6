"""Format counts, times and labels for pages, reports and terminals.

This module imports the standard library only, so that every command may use it.
"""

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Any

from sysid.core.text import DASH, format_criterion, format_number, format_unit, plain_unit
from sysid.core.units import is_known_unit

_THIN_SPACE = "\u202f"  # narrow no-break space: groups digits and joins a number to its unit
_MAX_JSON = 60
FORMULA_STARTS = (*"=+-@\t\r\n", *"\uff1d\uff0b\uff0d\uff20")  # the last four: full width
"""First characters of formulas in common spreadsheets."""
_SKIPPED = ' "\u00a0\u2007\u202f\ufeff'
"""What spreadsheets skip before a formula."""
_CELL_ENDS = re.compile(r"(?<=[;\n])")
_NUMBER = re.compile(r"[+-]?[0-9]*\.?[0-9]+([eE][+-]?[0-9]+)?")


def format_count(value: float | None) -> str:
    """Format a whole number in groups of three digits."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:,.0f}".replace(",", _THIN_SPACE)


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
    if isinstance(value, bool):
        return "yes" if value else "no"
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


def format_subtracted(trend: Mapping[str, Any]) -> str:
    """Format what was subtracted from a channel: its mean, or its straight line.

    Parameters
    ----------
    trend : mapping
        An entry of ``details.subtracted`` of a dataset.

    Examples
    --------
    >>> format_subtracted({"channel": "y", "unit": "V", "time": 1.0, "value": 2.5, "slope": -0.2})
    'y: 2.5 V - 0.2 V/s*(t - 1 s)'
    """
    unit, slope = trend["unit"], trend["slope"]
    text = f"{trend['channel']}: {trend['value']:.5g}{plain_unit(unit)}"
    if slope == 0:
        return text
    per_second = plain_unit("1/s" if unit in ("1", "") else f"{unit}/s")
    line = f"{abs(slope):.5g}{per_second}*(t - {trend['time']:g} s)"
    return f"{text} {'-' if slope < 0 else '+'} {line}"


def name_label(name: str) -> str:
    """Name a label with its unit, if its name ends with one.

    Examples
    --------
    >>> name_label("length_m"), name_label("number")
    ('length [m]', 'number')
    """
    quantity, _, unit = name.rpartition("_")
    return f"{quantity} [{unit}]" if quantity and is_known_unit(unit) else name


def write_csv(rows: Iterable[Iterable[object]]) -> str:
    """Write rows as CSV lines. Texts are escaped, None is an empty field.

    A float keeps all its digits: it comes back bit for bit.
    """
    sink = io.StringIO()
    csv.writer(sink, lineterminator="\n").writerows(map(_escape_formula, row) for row in rows)
    return sink.getvalue()


def _escape_formula(value: object) -> object:
    """Escape a value so that no spreadsheet evaluates it and no reader splits it into two lines.

    Where the comma is a decimal sign, spreadsheets split lines at semicolons, also within quotes.
    """
    if not isinstance(value, str):
        return value
    head, *parts = _CELL_ENDS.split(value)
    escaped = ["'" + part if _is_formula(part) else part for part in parts]
    return "".join(("'" if _is_formula(value) else "", head, *escaped)).replace("\r", " ")


def unescape_formula(text: str) -> str:
    """Return a text without the apostrophes that `write_csv` put before formulas."""
    head, *parts = _CELL_ENDS.split(text)
    return _strip_escape("".join((head, *map(_strip_escape, parts))))


def _strip_escape(text: str) -> str:
    return text[1:] if text.startswith("'") and _is_formula(text[1:]) else text


TEMPLATE_FILTERS = {
    "number": format_number,
    "criterion": format_criterion,
    "unit": format_unit,
    "count": format_count,
    "duration": format_duration,
    "age": format_age,
    "label_name": name_label,
    "subtracted": format_subtracted,
}


def _is_formula(text: str) -> bool:
    """Test whether a spreadsheet evaluates a text, also behind quotes and spaces."""
    shown = text.lstrip(_SKIPPED)
    return shown.startswith(FORMULA_STARTS) and not _NUMBER.fullmatch(shown.rstrip(";"))


def _shorten(text: str) -> str:
    return text if len(text) <= _MAX_JSON else f"{text[: _MAX_JSON - 3]}…"
