"""Texts of date stamps and times of day as seconds from the first sample."""

import re
from datetime import UTC
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.formats.advice import GIVE_PERIOD
from service.formats.stamp_numbers import DAY_FIRST, find_form, parse_form
from service.formats.tabular.cells import CLOCK_TIME, MISSING, STAMP
from service.formats.tabular.table_columns import (
    ColumnValues,
    build_missing_time_error,
    shorten_text,
)
from sysid.core.errors import UnreadableFile
from sysid.core.types import FloatArray, IntArray
from sysid.data.records import measure_sampling
from sysid.data.table_rules import TimeAxis, count_from_first, format_moment

_DAY_SECONDS: Final = 86_400.0


def read_stamp_times(
    stamps: NDArray[np.datetime64], name: str, is_utc: bool, notes: list[str]
) -> TimeAxis:
    """Convert time stamps to seconds from the first one, with a note on how they were read."""
    times, start = count_from_first(stamps)
    if is_utc:
        start = start.replace(tzinfo=UTC)
    zone = "UTC" if is_utc else "local"
    notes.append(
        f"column {name!r} read as {zone} time stamps, {_describe_period(times)}, from "
        f"{format_moment(start)}"
    )
    return TimeAxis(times, start)


def read_clock_times(
    texts: NDArray[np.str_], rows: IntArray, name: str, notes: list[str]
) -> TimeAxis:
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
    return TimeAxis(times)


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
    if np.any(np.diff(times) < 0):
        return "not in order"
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
    UnreadableFile
        If a stamp is missing or has another form; with its row.
    """
    first = next((text for text in texts.tolist() if STAMP.fullmatch(text)), str(texts[0]))
    form = find_form(first)
    if form is None:
        raise _build_stamp_error(texts, 0, rows, name, "a date such as 2026-01-31 12:00:00")
    attempts = parse_form(texts, form)
    readings = {order: read for order, read in attempts.items() if not np.isnat(read).any()}
    if not readings:
        place = int(np.flatnonzero(np.isnat(attempts[DAY_FIRST]))[0])
        is_date = STAMP.fullmatch(str(texts[place])) is not None
        wanted = "a date that exists, from 1678 to 2261" if is_date else f"a stamp such as {first}"
        raise _build_stamp_error(texts, place, rows, name, wanted)
    order = min(readings, key=lambda order: _rank_reading(readings[order]))
    if len(attempts) > 1:
        notes.append(f"dates of column {name!r} were read with the {order}")
    return readings[order], form.has_zone


def _rank_reading(stamps: NDArray[np.datetime64]) -> tuple[bool, int]:
    """Rank one order of day and month: times that increase come first, then the shorter span."""
    ticks = stamps.astype(np.int64)
    return bool(np.any(np.diff(ticks) < 0)), int(np.ptp(ticks))


def _build_stamp_error(
    texts: NDArray[np.str_], place: int, rows: IntArray, name: str, wanted: str
) -> UnreadableFile:
    text, row = str(texts[place]), int(rows[place])
    if text.lower() in MISSING:
        return build_missing_time_error(text, row, name)
    return UnreadableFile(
        f"found {shorten_text(text)}; need {wanted}. Write all time stamps in one form, or ",
        GIVE_PERIOD,
        row=row,
        column=name,
    )
