"""Columns of times as seconds from the first sample: numbers, date stamps, times of day.

A clock that counts from 1970 or has dates also gives the moment of time 0 s.
"""

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from service.formats.cells import CLOCK_TIME, DATE_ONLY, MISSING, STAMP
from service.formats.errors import InvalidUpload
from service.formats.table_columns import (
    ColumnValues,
    build_missing_time_error,
    shorten_text,
)
from service.formats.table_layout import find_unit_seconds, is_plain_time_name
from sysid.core.types import FloatArray, IntArray
from sysid.data.records import measure_sampling

if TYPE_CHECKING:
    import polars as pl

EPOCH_THRESHOLD_SECONDS: Final = 1e8
"""Times (s) that begin later than this (three years) are clock times since some epoch."""
_PLAUSIBLE_CLOCK: Final = (6.3e8, 4.2e9)  # s since 1970: the years 1990 to 2103
_EPOCH_UNITS: Final = (("ms", "milliseconds"), ("us", "microseconds"), ("ns", "nanoseconds"))
_DAY_SECONDS: Final = 86_400.0
_SERIAL_DAYS: Final = (36_526.0, 73_050.0)  # of a spreadsheet: the years 2000 to 2099
_SERIAL_ORIGIN: Final = np.datetime64("1899-12-30T00:00:00", "us")
_EXACT_INTEGER: Final = 2.0**53
_ZONE_FORM: Final = "%#z"
_EXACT_DECIMALS: Final = 6  # of s since 1970 in a number of 53 bits


@dataclass(frozen=True, slots=True, eq=False)
class ClockTimes:
    """Times in s, and the moment of time 0 s if it is known."""

    times: FloatArray
    started_at: datetime | None = None


def find_clock_start(seconds: float) -> datetime | None:
    """Return the moment of a clock that counts seconds since 1970; None if it cannot be one."""
    first, last = _PLAUSIBLE_CLOCK
    return datetime.fromtimestamp(seconds, UTC) if first <= seconds <= last else None


def read_number_times(values: FloatArray, name: str, unit: str, notes: list[str]) -> ClockTimes:
    """Convert a column of numbers to seconds; a clock is counted from the first sample.

    Numbers without a unit are s, unless they can only be a finer clock since 1970, or the days
    since 1900 that a spreadsheet counts.
    """
    if _are_serial_dates(values, unit):
        notes.append(f"column {name!r} holds serial dates of a spreadsheet, in days")
        return read_stamp_times(_read_serial_dates(values), name, False, notes)
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
        return ClockTimes(_scale_times(values, size))
    origin = float(values[0])
    shown = f"{origin:.0f}" if origin >= _EXACT_INTEGER else repr(origin)
    shifted = np.round(_scale_times(values - origin, size), _EXACT_DECIMALS if size == 1.0 else 9)
    start = find_clock_start(float(_scale_times(np.array([origin]), size)[0]))
    moment = "" if start is None else f" ({format_moment(start)})"
    notes.append(
        f"times are counted from the first sample, at {shown} {unit or 's'} of the file's clock"
        f"{moment}"
    )
    return ClockTimes(shifted, start)


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


def format_moment(moment: datetime) -> str:
    """Format a moment for notes: ``2026-01-31 12:00:00``, with UTC if that is its zone."""
    return moment.replace(tzinfo=None).isoformat(" ") + (" UTC" if moment.tzinfo else "")


def read_stamp_times(
    stamps: NDArray[np.datetime64], name: str, is_utc: bool, notes: list[str]
) -> ClockTimes:
    """Convert time stamps to seconds from the first one, with a note on how they were read."""
    ticks = stamps.astype("datetime64[ns]").astype(np.int64)
    times = (ticks - ticks[0]) / 1e9
    start: datetime = stamps[0].astype("datetime64[us]").item()
    if is_utc:
        start = start.replace(tzinfo=UTC)
    zone = "UTC" if is_utc else "local"
    notes.append(
        f"column {name!r} read as {zone} time stamps, {_describe_period(times)}, from "
        f"{format_moment(start)}"
    )
    return ClockTimes(times, start)


def read_clock_times(
    texts: NDArray[np.str_], rows: IntArray, name: str, notes: list[str]
) -> ClockTimes:
    """Convert times of day or elapsed times, ``12:30:00.5``; after midnight they go on."""
    matches = [CLOCK_TIME.fullmatch(text) for text in texts.tolist()]
    if None in matches:
        raise _build_stamp_error(
            texts, matches.index(None), rows, name, "a time of day such as 12:30:00"
        )
    times = np.array([_read_clock(match) for match in matches if match is not None])
    midnights = np.diff(times) < -_DAY_SECONDS / 2
    times[1:] += _DAY_SECONDS * np.cumsum(midnights)
    times = np.round(times - times[0], 9)
    notes.append(
        f"column {name!r} read as times of day, {_describe_period(times)}, from {texts[0]}"
    )
    return ClockTimes(times)


def _read_clock(match: re.Match[str]) -> float:
    """Return the seconds since midnight."""
    hour, minute, second = (int(match[part] or 0) for part in ("hour", "minute", "second"))
    fraction = float("0." + (match["fraction"] or ".0")[1:])
    if match["second"] is None and match["fraction"] is not None:  # minutes and seconds
        return 60.0 * hour + minute + fraction
    if match["half"]:
        hour = hour % 12 + (12 if match["half"] in "pP" else 0)
    return 3600.0 * hour + 60.0 * minute + second + fraction


def _describe_period(times: FloatArray) -> str:
    sampling = measure_sampling(times)
    if sampling.samples < 2:
        return "one sample"
    return f"{sampling.period:.6g} s apart" + ("" if sampling.is_regular else " (median)")


def join_dates(dates: ColumnValues, clocks: ColumnValues) -> NDArray[np.str_]:
    """Join a column of dates and one of times of day to time stamps."""
    joined = [f"{date} {clock}" for date, clock in zip(dates, clocks, strict=True)]
    return np.array(joined, dtype=np.str_)


def parse_stamps(
    texts: NDArray[np.str_], rows: IntArray, name: str, notes: list[str]
) -> tuple[NDArray[np.datetime64], bool]:
    """Parse date stamps, and tell whether they are in UTC.

    All have the form of the first one. Of two possible orders of day and month the one is taken
    in which all stamps are dates, and increase over the shorter time.

    Raises
    ------
    InvalidUpload
        If a stamp is missing or has another form; with its row.
    """
    first = next((text for text in texts.tolist() if STAMP.fullmatch(text)), str(texts[0]))
    forms = _list_forms(first)
    if not forms:
        raise _build_stamp_error(texts, 0, rows, name, "a date such as 2026-01-31 12:00:00")
    stamps = _normalise_stamps(texts)
    attempts = [(form, _parse_form(stamps, form)) for form in forms]
    readings = [attempt for attempt in attempts if not np.isnat(attempt[1]).any()]
    if not readings:
        place = int(np.flatnonzero(np.isnat(attempts[0][1]))[0])
        raise _build_stamp_error(texts, place, rows, name, f"a time stamp such as {first}")
    form, parsed = min(readings, key=lambda reading: _rank_reading(reading[1]))
    if len(forms) > 1:
        order = "day before the month" if form.startswith("%d") else "month before the day"
        notes.append(f"dates of column {name!r} were read with the {order}")
    return parsed, form.endswith(_ZONE_FORM)


def _list_forms(text: str) -> list[str]:
    """List the forms that the first time stamp may have, as `strptime` writes them."""
    match = STAMP.fullmatch(text) or DATE_ONLY.fullmatch(text)
    if match is None:
        return []
    parts = match.groupdict()
    zone = _ZONE_FORM if parts.get("zone") else ""
    if parts.get("basic"):
        return [f"%Y%m%d %H%M%S%.f{zone}"]
    if parts["iso"]:
        days = ["%Y{0}%m{0}%d".format(text[4])]
    elif parts["month"]:
        days = ["%d-%b-%Y"]
    else:
        sign = "." if parts["day"] or parts["short"] else parts["sign"] or "/"
        year = "%y" if parts["short"] or parts["either_short"] else "%Y"
        orders = ("%d{0}%m{0}{1}", "%m{0}%d{0}{1}")[: 1 if sign == "." else 2]
        days = [order.format(sign, year) for order in orders]
    clock = "%I:%M:%S%.f %p" if parts.get("half") else "%H:%M:%S%.f"
    return [f"{day} {clock}{zone}" for day in days]


def _normalise_stamps(texts: NDArray[np.str_]) -> "pl.Series":
    """Write the same time stamp in one way: one blank, decimal points, ``Z`` for UTC."""
    import polars as pl  # loaded only where stamps are read: its start takes time

    series = pl.Series(texts.tolist(), dtype=pl.String)
    for pattern, text in (
        (r"^([^T\s]*)[T\s]+", "$1 "),
        (r",\s", " "),
        (r"(\d{2}),(\d+)", "$1.$2"),
        (r"\s?([AaPp])\.?[Mm]\.?$", " ${1}M"),
        (r"\s?(UTC|GMT|z)$", "Z"),
        (r"\s([+-]\d{2}:?\d{2})$", "$1"),
        (r"([+-]\d{2})$", "$1"),
        (r"^(\S+)$", "$1 00:00:00"),
        (r"( \d{1,3}:\d{2})($|[^:.\d].*$)", "$1:00$2"),
    ):
        series = series.str.replace(pattern, text)
    return series


def _parse_form(stamps: "pl.Series", form: str) -> NDArray[np.datetime64]:
    """Parse time stamps of one form; one of another form gives NaT."""
    zone = "UTC" if form.endswith(_ZONE_FORM) else None
    parsed = stamps.str.to_datetime(form, strict=False, time_unit="ns", time_zone=zone)
    return np.asarray(parsed.dt.replace_time_zone(None).to_numpy(), dtype="datetime64[ns]")


def _rank_reading(stamps: NDArray[np.datetime64]) -> tuple[bool, int]:
    """Rank one order of day and month: times that increase come first, then the shorter span."""
    ticks = stamps.astype(np.int64)
    return bool(np.any(np.diff(ticks) < 0)), int(np.ptp(ticks))


def _build_stamp_error(
    texts: NDArray[np.str_], place: int, rows: IntArray, name: str, wanted: str
) -> InvalidUpload:
    text, row = str(texts[place]), int(rows[place])
    if text.lower() in MISSING:
        return build_missing_time_error(text, row, name)
    return InvalidUpload(
        f"found {shorten_text(text)}; need {wanted}. Write all time stamps in one form, or give "
        "the sampling period with sample_time.",
        row=row,
        column=name,
    )
