"""What one cell of a table holds: a number, a time stamp, a word, or nothing."""

import re
from collections.abc import Iterable
from typing import Final

from sysid.data.table_rules import CellKind

MISSING: Final = frozenset(
    (
        *("", "na", "n/a", "nan", "-nan", "null", "none", "-", "--", "---", "?", "."),
        *("#n/a", "#nv", "#na", "#div/0!", "#num!", "#value!", "#ref!"),  # of spreadsheets
    )
)
"""Words of a missing value, in small letters."""
BAD_WORDS: Final = frozenset(
    (
        *("bad", "bad input", "bad data", "bad quality", "i/o timeout", "io timeout", "no data"),
        *("scan off", "scan timeout", "comm fail", "not connect", "configure", "shutdown"),
        *("intf shut", "pt created", "no result", "no sample", "calc failed", "calc off"),
        *("out of serv", "invalid data", "invalid", "equip fail", "under range", "over range"),
        *("inp outrange", "arc off-line", "access denied", "undefined", "doubtful", "error"),
        *("unavailable", "unknown", "timeout", "offline", "fault", "failed"),
    )
)
"""Words that mark a bad value, in small letters; see `service.formats.tabular.bad_values`."""
FLAGS: Final = {"true": 1.0, "false": 0.0}

_NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?|[+-]?inf(?:inity)?", re.I)
_NUMBER_START = re.compile(r"[+-]?\s?[.,]?\d")
_DATE = (
    r"(?P<iso>\d{4}[-/.]\d{1,2}[-/.]\d{1,2})"
    r"|(?P<day>\d{1,2}\.\d{1,2}\.\d{4})"
    r"|(?P<short>\d{1,2}\.\d{1,2}\.\d{2})"
    r"|(?P<either>\d{1,2}(?P<sign>[/-])\d{1,2}(?P=sign)\d{4})"
    r"|(?P<either_short>\d{1,2}/\d{1,2}/\d{2})"
    r"|(?P<month>\d{1,2}-[A-Za-z]{3}-\d{4})"
)
_CLOCK = (
    r"(?P<hour>\d{1,3}):(?P<minute>\d{2})(?::(?P<second>\d{2}))?(?P<fraction>[.,]\d*)?"
    r"(?:\s?(?P<half>[AaPp])\.?[Mm]\.?)?"
)
_ZONE = r"(?P<zone>Z|z|\s?UTC|\s?GMT|\s?[+-]\d{2}:?\d{2}|[+-]\d{2})"
_BASIC = r"(?P<basic>\d{8}T\d{6})(?:[.,]\d*)?"
STAMP: Final = re.compile(rf"(?:(?:{_DATE})(?:[Tt]|,?\s+)(?:{_CLOCK})|{_BASIC}){_ZONE}?")
DATE_ONLY: Final = re.compile(_DATE)
CLOCK_TIME: Final = re.compile(_CLOCK)


def classify_cell(text: str) -> CellKind:
    """Return what a cell holds."""
    text = text.strip()
    if text.lower() in MISSING or text.lower() in BAD_WORDS:
        return "empty"
    if _NUMBER.fullmatch(text):
        return "number"
    if text.lower() in FLAGS:
        return "flag"
    if text[0].isdigit():
        if STAMP.fullmatch(text):
            return "stamp"
        if CLOCK_TIME.fullmatch(text):
            return "clock"
        if DATE_ONLY.fullmatch(text):
            return "date"
    return "text"


def classify_column(cells: Iterable[str]) -> CellKind:
    """Return what a column holds: a number wins, since a text among numbers is a fault."""
    kinds = {classify_cell(cell) for cell in cells} - {"empty"}
    if not kinds:
        return "empty"
    if "number" in kinds:
        return "number"
    if kinds == {"stamp", "date"}:  # some programs write midnight as a date
        return "stamp"
    return kinds.pop() if len(kinds) == 1 else "text"


def begins_like_number(text: str) -> bool:
    """Whether a text that is no number begins like one, such as ``1,000.5`` or ``5 V``."""
    return _NUMBER_START.match(text.strip()) is not None
