"""Markers of bad data: words among numbers, numbers that stand for no value, columns of status.

The words are the digital states that a PI server writes in place of a value (AVEVA, *PI Data
Archive: system digital state set*), states of Home Assistant and the point of SAS and NONMEM. The
numbers are fill values in use: those of nines (NOAA, ESRI), of well logs (LAS 2.0: -999.25), the
limits of integers and of floats, and fill values of netCDF such as 1e20. A number is taken for a
marker only if it stands apart: further from all other values than these span.

Quality codes follow OPC (*Data Access 3.0*, 6.8): the upper two of eight bits are set if a value is
good.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from service.formats.tabular.cells import BAD_WORDS
from service.formats.tabular.table_columns import ColumnValues, Table
from sysid.core.types import BoolArray, FloatArray

NO_GUESS: Final = "none"
"""Given as the only marker, it says that no number is one."""

_NINES: Final = tuple(float("9" * count) for count in range(3, 11))
_MARKERS: Final = np.array(
    [
        *(sign * number for number in (*_NINES, 999.25, 9999.25) for sign in (1.0, -1.0)),
        *(-32768.0, 32767.0, 65535.0, -2147483648.0, 2147483647.0, 4294967295.0),
    ]
)
_FILLS: Final = np.array(
    [1e20, 1e30, 1e35, 9.969209968386869e36, 3.4028234663852886e38, np.finfo(np.float64).max]
)
_FILL_TOLERANCE: Final = 1e-5  # they are printed with six digits
_MIN_LEVELS: Final = 3  # of two levels alone, one may be as far as it likes
_GOOD_QUALITY: Final = 0xC0
_QUALITY_BITS: Final = 0xFF

_STATUS = re.compile(
    r"(?P<name>.*?)[\s._:/-]*(?P<word>status|quality|qual|is ?good|good|is ?valid|valid)$", re.I
)
_TRUTH_WORDS: Final = ("good", "valid")
"""Ends of names under which 1 says that a value is good; a status of 1 may be that of a pump."""
_GOOD = re.compile(r"(?:good|ok|valid|normal|true)\b", re.I)
_BAD = re.compile(
    r"(?:invalid|uncertain|questionable|suspect|false|bad|error|fault|fail|no\b|not\b)", re.I
)


def find_markers(values: FloatArray, given: Sequence[str]) -> tuple[float, ...]:
    """Find the numbers among the values of a channel that mark bad data.

    Parameters
    ----------
    given : sequence of str
        Markers of the user. If there are any, no other number is one.
    """
    present = values[np.isfinite(values)]
    if given:
        numbers = (_parse_number(text) for text in given)
        return tuple(number for number in numbers if number is not None and number in present)
    is_candidate = _find_candidates(present)
    if not is_candidate.any():
        return ()
    rest = np.unique(present[~is_candidate])
    if rest.size < _MIN_LEVELS:
        return ()
    least, most = float(rest[0]), float(rest[-1])
    candidates = np.unique(present[is_candidate]).tolist()
    return tuple(x for x in candidates if max(least - x, x - most) > most - least)


def _parse_number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _find_candidates(values: FloatArray) -> BoolArray:
    """Find the values that are a number of the list."""
    sizes = np.abs(values)
    is_candidate = np.zeros(values.size, dtype=np.bool_)
    large = np.flatnonzero(sizes >= np.min(np.abs(_MARKERS)))
    if large.size:
        is_fill = np.abs(sizes[large, np.newaxis] / _FILLS - 1.0) <= _FILL_TOLERANCE
        is_candidate[large] = np.isin(values[large], _MARKERS) | is_fill.any(axis=1)
    return is_candidate


@dataclass(frozen=True, slots=True)
class _Status:
    """A column of status: the place of its channel, None for all, and where values are good."""

    column: int
    channel: int | None
    is_good: BoolArray


def apply_status_columns(table: Table, notes: list[str]) -> Table:
    """Return the table without its columns of status, and with bad values missing."""
    columns, values = list(table.columns), list(table.values)
    signals = [i for i, column in enumerate(columns) if column.role == "value"]
    for status in _find_status_columns(table):
        name = columns[status.column].name
        own = signals if status.channel is None else [status.channel]
        columns[status.column] = replace(columns[status.column], role="unused")
        count = int(np.count_nonzero(~status.is_good))
        for place in own:
            if place != status.column and values[place].dtype.kind == "f":
                values[place] = np.where(status.is_good, values[place], np.nan)
        what = "all signals" if status.channel is None else repr(columns[status.channel].name)
        notes.append(
            f"column {name!r} tells which values of {what} are good; {count} are bad and read as "
            "missing"
        )
    return replace(table, columns=tuple(columns), values=tuple(values))


def _find_status_columns(table: Table) -> list[_Status]:
    """Find columns that say of a channel, or of all, which values are good."""
    places = {
        column.name.lower(): i for i, column in enumerate(table.columns) if column.role == "value"
    }
    found = []
    for i, column in enumerate(table.columns):
        match = _STATUS.fullmatch(column.name)
        if match is None or column.role not in ("value", "text"):
            continue
        channel = places.get(match["name"].lower()) if match["name"] else None
        if match["name"] and channel is None:
            continue
        is_truth = match["word"].lower().endswith(_TRUTH_WORDS)
        is_good = _read_status(table.values[i], is_truth=is_truth)
        if is_good is not None:
            found.append(_Status(i, channel, is_good))
    shared = [status for status in found if status.channel is None]
    return found if len(shared) < 2 else [one for one in found if one.channel is not None]


def _read_status(values: ColumnValues, *, is_truth: bool) -> BoolArray | None:
    """Read where values are good; None if this is no status."""
    if values.dtype.kind != "U":
        codes = np.asarray(values, dtype=np.float64)
        return codes == 1.0 if is_truth and np.isin(codes, (0.0, 1.0)).all() else _read_codes(codes)
    texts = [str(text).strip() for text in values.tolist()]
    good = [_GOOD.match(text) is not None for text in texts]
    known = [
        one or not text or _BAD.match(text) is not None or text.lower() in BAD_WORDS
        for one, text in zip(good, texts, strict=True)
    ]
    return np.array(good) if any(good) and all(known) else None


def _read_codes(codes: FloatArray) -> BoolArray | None:
    """Read where quality codes of OPC are good; None if these are no such codes."""
    is_quality = np.all((codes >= 0) & (codes <= _QUALITY_BITS) & (codes == np.rint(codes)))
    if not is_quality or not np.any(codes == _GOOD_QUALITY):
        return None
    good: BoolArray = codes >= _GOOD_QUALITY
    return good


def mask_markers(
    name: str, values: FloatArray, given: Sequence[str], notes: list[str]
) -> FloatArray:
    """Return values in which numbers that mark bad data are missing, and tell which."""
    for marker in find_markers(values, given):
        is_marker = values == marker
        count = int(np.count_nonzero(is_marker))
        values = np.where(is_marker, np.nan, values)
        way = "" if given else f". If it is a value, give missing={NO_GUESS} (--missing {NO_GUESS})"
        notes.append(f"channel {name!r}: {marker:.16g} marks {count} values as missing{way}")
    return values
