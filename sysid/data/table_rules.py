"""Rules of tables: which column holds the times, in which unit, and on which clock.

They hold for files of every kind and for tables of other libraries. What is guessed is a note.
"""

import re
import warnings
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import lru_cache
from inspect import currentframe
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sysid.core.types import FloatArray
from sysid.core.units import find_conversion_factor, is_known_unit

CellKind: TypeAlias = Literal["empty", "number", "flag", "stamp", "date", "clock", "text", "count"]
"""What a column holds.

``stamp`` is a date with a time of day, ``clock`` a time of day, ``flag`` true or false, and
``count`` a column that numbers the rows.
"""
STAMP_KINDS: Final = ("stamp", "date", "clock")

_OUR_PACKAGES: Final = ("sysid", "service", "lagid")
_TIME_NAMES: Final = ("t", "time")
_DATE_WORDS: Final = frozenset(("date", "datum"))
_TIME_WORDS: Final = frozenset(
    (
        *(*_TIME_NAMES, *_DATE_WORDS),
        *("timestamp", "time stamp", "datetime", "date time", "date/time"),
        *("elapsed", "elapsed time", "time elapsed", "sec", "secs", "seconds"),
        *("zeit", "zeitstempel", "uhrzeit", "datum/zeit", "datum/uhrzeit"),
        *("datum zeit", "datum uhrzeit", "temps", "tiempo", "tempo", "tijd", "tid", "x value"),
    )
)
NO_NAMES: Final = ("", "unnamed: 0", "__index_level_0__")
_COUNTED: Final = ("sample", "row", "record", "scan")
_COUNTS: Final = ("index", "no", "nr", "number", "#")
_INDEX_WORDS: Final = frozenset(
    (*_COUNTED, *_COUNTS, "idx", *(f"{what} {count}" for what in _COUNTED for count in _COUNTS))
)
_SECOND_NAMES: Final = ("", "s", "sec", "secs", "second", "seconds")
_LONG_UNITS: Final = {
    **dict.fromkeys(("minute", "minutes", "mins"), "min"),
    **dict.fromkeys(("hour", "hours", "hrs"), "h"),
    **dict.fromkeys(("millisecond", "milliseconds", "msec", "msecs"), "ms"),
    **dict.fromkeys(("microsecond", "microseconds", "usec", "usecs", "μs"), "us"),
    **dict.fromkeys(("nanosecond", "nanoseconds", "nsec"), "ns"),
    "days": "day",
}
MAX_TIME_UNIT = 86_400.0
"""Longest unit of time in s (a day); a longer one is taken for a mistake."""

_TEMPERATURE_RANK: Final = 5

_BRACKETS = re.compile(r"^(?P<name>.*?)\s*\[(?P<unit>[^\[\]]*)\]$", re.DOTALL)
_PARENTHESES = re.compile(r"^(?P<name>.*?)\s*\((?P<unit>[^()]*(?:\([^()]*\))?[^()]*)\)$", re.DOTALL)
_SLASH = re.compile(r"^(?P<name>[^/]+?)\s*(?:/|\s+in\s+)\s*\(?(?P<unit>[^()]+?)\)?$", re.DOTALL)

EPOCH_THRESHOLD_SECONDS: Final = 1e8
"""Times (s) that begin later than this (three years) are clock times since some epoch."""
_PLAUSIBLE_CLOCK: Final = (6.3e8, 4.2e9)  # s since 1970: the years 1990 to 2103
_EPOCH_UNITS: Final = (("ms", "milliseconds"), ("us", "microseconds"), ("ns", "nanoseconds"))
_DAY_SECONDS: Final = 86_400.0
_SERIAL_DAYS: Final = (36_526.0, 73_050.0)  # of a spreadsheet: the years 2000 to 2099
_SERIAL_ORIGIN: Final = np.datetime64("1899-12-30T00:00:00", "us")
_EXACT_INTEGER: Final = 2.0**53
_EXACT_DECIMALS: Final = 6  # of s since 1970 in a number of 53 bits


class ReadingNote(UserWarning):
    """What was guessed or found while a file or a table was read.

    Examples
    --------
    >>> import warnings
    >>> with warnings.catch_warnings(action="ignore", category=ReadingNote):
    ...     recording = Recording({"t [ms]": [0, 500], "u": [1, 2]})
    >>> recording.duration
    0.5
    """


def tell_notes(notes: Sequence[str]) -> None:
    """Tell each note as a warning of the code outside lagid that reads."""
    level, frame = 1, currentframe()
    while frame is not None and _is_ours(frame.f_globals.get("__name__")):
        level, frame = level + 1, frame.f_back
    for note in notes:
        warnings.warn(note, ReadingNote, stacklevel=level)


def _is_ours(module: object) -> bool:
    return str(module).partition(".")[0] in _OUR_PACKAGES


class Heading(NamedTuple):
    """Name and unit of a column, and what its first cells hold."""

    name: str
    unit: str
    kind: CellKind


class TimeAxis(NamedTuple):
    """Times (s), and the moment of time 0 s if it is known; a zone only if the source has one.

    `unit` is the unit in which the source has them.
    """

    seconds: FloatArray
    started_at: datetime | None = None
    unit: str = "s"


class DatedAxis(NamedTuple):
    """Times (s) from a moment."""

    seconds: FloatArray
    started_at: datetime


def split_headings(names: Sequence[str]) -> list[tuple[str, str]]:
    """Split names of columns into name and unit: ``u [V]``, ``u (V)``.

    If the time is written ``t/s``, as a standard has it, so are the others.
    """
    slashes = any(
        unit and find_time_word(name) is not None and find_unit_seconds(unit) is not None
        for name, unit in (_split_heading(text, slashes=True) for text in names)
    )
    return [_split_heading(text, slashes=slashes) for text in names]


def _split_heading(heading: str, *, slashes: bool) -> tuple[str, str]:
    text = heading.strip()
    if match := _BRACKETS.match(text):
        return match["name"], match["unit"].strip()
    if (match := _PARENTHESES.match(text)) and is_unit(match["unit"]) and match["name"]:
        return match["name"].rstrip(" /"), match["unit"].strip()
    if slashes and (match := _SLASH.match(text)) and is_unit(match["unit"]):
        return match["name"], match["unit"].strip()
    return text, ""


@lru_cache(maxsize=1024)
def is_unit(text: str) -> bool:
    """Whether a text is a unit."""
    return is_known_unit(text) or (bool(text.strip()) and find_unit_seconds(text) is not None)


def is_nameless(heading: Heading) -> bool:
    """Whether a column has no name of its own: that of an index, or none."""
    return heading.kind == "count" or heading.name.lower() in NO_NAMES


def is_index_name(name: str) -> bool:
    """Whether a column of this name is left out if it counts rows: ``No.``, ``Sample #``, none."""
    return name.lower() in NO_NAMES or simplify_name(name).removesuffix(".") in _INDEX_WORDS


def simplify_name(name: str) -> str:
    """Return a name in small letters, with one blank between its words."""
    return " ".join(re.sub(r"[_-]", " ", name.lower()).split())


def counts_rows(texts: Sequence[str]) -> bool:
    """Whether cells count rows from 0 or from 1."""
    first = texts[0].strip() if texts else ""
    return (
        len(texts) > 1
        and first in ("0", "1")
        and all(text.strip() == str(number) for number, text in enumerate(texts, int(first)))
    )


def find_time_column(headings: Sequence[Heading | None], *, has_period: bool = False) -> int | None:
    """Find the column of times: by a usual name, or because it holds time stamps.

    A column that is None has another role. With a sampling period a column ``T`` is no time.
    """
    ranks = [
        (rank, index)
        for index, heading in enumerate(headings)
        if heading is not None and (rank := _rank_time(heading, index)) is not None
    ]
    rank, index = min(ranks, default=(_TEMPERATURE_RANK, None))
    return None if has_period and rank == _TEMPERATURE_RANK else index


def _rank_time(heading: Heading, index: int) -> int | None:
    """Rank a column as the one of times, the best first; None if it cannot be."""
    name, kind, is_stamp = heading.name, heading.kind, heading.kind in STAMP_KINDS
    word = find_time_word(name)
    if is_temperature_name(name):
        is_time = not is_stamp and find_unit_seconds(heading.unit) is not None
        return _TEMPERATURE_RANK if is_time else 3 if is_stamp else None
    if word in _TIME_NAMES and not is_nameless(heading):
        return 0
    if word is not None and (is_stamp or word not in _DATE_WORDS):
        return 1 if kind == "stamp" else 2
    if is_stamp:
        return 3 if kind == "stamp" else 4
    # The index of a table, which is its time.
    is_index = is_nameless(heading) and kind == "number" and (index == 0 or bool(name))
    return 6 if is_index else None


def is_temperature_name(name: str) -> bool:
    """Whether a column is called ``T``, which is often a temperature and seldom the time."""
    return name == "T"


def is_plain_time_name(name: str) -> bool:
    """Whether a column is called ``t`` or ``time``, so that its unit is s unless it has one."""
    return find_time_word(name) in _TIME_NAMES and not is_temperature_name(name)


def is_time_name(name: str) -> bool:
    """Whether a column of this name holds times."""
    return find_time_word(name) is not None


def find_time_word(name: str) -> str | None:
    """Return the usual name of time that a name is, without a unit at its end."""
    text = simplify_name(name)
    if text in _TIME_WORDS:
        return text
    word, _, unit = text.rpartition(" ")
    return word if unit and word in _TIME_WORDS and find_unit_seconds(unit) is not None else None


def find_time_unit(name: str, unit: str) -> str:
    """Return the unit of a column of times; it may be the end of the name, as in ``time_ms``."""
    end = re.split(r"[ _-]", name)[-1].lower()
    if unit or end in _SECOND_NAMES or end == name.lower() or find_unit_seconds(end) is None:
        return unit
    return end


def find_unit_seconds(unit: str) -> float | None:
    """Return the seconds in one unit of a column of times; None if it is no unit of time."""
    lower = unit.strip().lower()
    if lower in _SECOND_NAMES:
        return 1.0
    seconds = find_conversion_factor(_LONG_UNITS.get(lower, unit.strip()), "s")
    return seconds if seconds is not None and 0 < seconds <= MAX_TIME_UNIT else None


def find_clock_start(seconds: float) -> datetime | None:
    """Return the moment of a clock that counts seconds since 1970; None if it cannot be one."""
    first, last = _PLAUSIBLE_CLOCK
    return datetime.fromtimestamp(seconds, UTC) if first <= seconds <= last else None


def read_number_times(values: FloatArray, name: str, unit: str, notes: list[str]) -> TimeAxis:
    """Convert a column of finite numbers to seconds; a clock is counted from the first sample.

    Numbers without a unit are s, unless they can only be a finer clock since 1970, or the days
    since 1900 that a spreadsheet counts.
    """
    if _are_serial_dates(values, unit):
        axis = count_from_first(_read_serial_dates(values))
        notes.append(
            f"column {name!r} holds serial dates of a spreadsheet, in days, from "
            f"{format_moment(axis.started_at)}"
        )
        return TimeAxis(*axis)
    first = float(np.min(values))
    if not unit:
        for symbol, word in _EPOCH_UNITS:
            size = find_unit_seconds(symbol) or 1.0
            if _PLAUSIBLE_CLOCK[0] <= first * size <= _PLAUSIBLE_CLOCK[1]:
                notes.append(f"column {name!r} was read as {word} since 1970")
                unit = symbol
    if not unit and not is_plain_time_name(name):
        notes.append(f"column {name!r} was read as the time in s")
    size = find_unit_seconds(unit) or 1.0
    if first * size < EPOCH_THRESHOLD_SECONDS:
        if size != 1.0:
            notes.append(
                f"times were converted from {unit} to s: delays and time constants are in s"
            )
        name = _LONG_UNITS.get(unit.lower(), unit) if size != 1.0 else "s"
        return TimeAxis(_scale_times(values, size), unit=name)
    origin = float(values[0])
    shown = f"{origin:.0f}" if origin >= _EXACT_INTEGER else repr(origin)
    shifted = np.round(_scale_times(values - origin, size), _EXACT_DECIMALS if size == 1.0 else 9)
    start = find_clock_start(float(_scale_times(np.array([origin]), size)[0]))
    moment = "" if start is None else f" ({format_moment(start)})"
    notes.append(
        f"times are counted from the first sample, at {shown} {unit or 's'} of the file's clock"
        f"{moment}"
    )
    return TimeAxis(shifted, start)


def _are_serial_dates(values: FloatArray, unit: str) -> bool:
    """Whether numbers are dates of a spreadsheet; without a unit, if they stay within a day."""
    first, last = float(np.min(values)), float(np.max(values))
    is_day = find_unit_seconds(unit) == _DAY_SECONDS
    is_possible = is_day or (not unit and 0 < last - first < 1.0)
    return is_possible and _SERIAL_DAYS[0] <= first <= last <= _SERIAL_DAYS[1]


def _read_serial_dates(values: FloatArray) -> NDArray[np.datetime64]:
    """Convert days to time stamps, rounded to 10 µs: a number of that size has no finer ones."""
    ticks = np.round(values * (_DAY_SECONDS * 1e5)).astype(np.int64) * 10
    return _SERIAL_ORIGIN + ticks.astype("timedelta64[us]")


def _scale_times(times: FloatArray, size: float) -> FloatArray:
    if size == 1.0:
        return times
    # Division by a whole number of units per second is correctly rounded, a product is not.
    converted: FloatArray = times * size if size > 1.0 else times / round(1.0 / size)
    return converted


def count_from_first(stamps: NDArray[np.datetime64]) -> DatedAxis:
    """Convert dates to seconds from the first one, which is the start without a zone."""
    ticks = stamps.astype("datetime64[ns]").astype(np.int64)
    start: datetime = stamps[0].astype("datetime64[us]").item()
    return DatedAxis((ticks - ticks[0]) / 1e9, start)


def read_spans(spans: NDArray[np.timedelta64]) -> FloatArray:
    """Convert time spans to seconds."""
    seconds: FloatArray = spans.astype("timedelta64[ns]").astype(np.int64) / 1e9
    return seconds


def format_moment(moment: datetime) -> str:
    """Format a moment for notes: ``2026-01-31 12:00:00``, with UTC if that is its zone."""
    return moment.replace(tzinfo=None).isoformat(" ") + (" UTC" if moment.tzinfo else "")
