"""Numbers of date stamps: many texts at once, by the columns in which their digits stand.

Stamps of one file differ in their digits alone, apart from names of months and from lengths of
fractions. So a text is analysed once for each such layout, and NumPy reads the digits of all.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from service.formats.tabular.cells import DATE_ONLY, STAMP
from sysid.core.types import IntArray

Order: TypeAlias = Literal["day before the month", "month before the day"]
DAY_FIRST: Final[Order] = "day before the month"
MONTH_FIRST: Final[Order] = "month before the day"

_BLOCK_ROWS: Final = 65_536
_DATES: Final = ("basic", "iso", "day", "short", "either", "either_short", "month")
_CLOCK: Final = ("hour", "minute", "second")
_NUMBER: Final = re.compile(r"\d+")
_BASIC_FRACTION: Final = re.compile(r".{15}[.,](?P<digits>\d*)")
_ZONE_NUMBER: Final = re.compile(r"\d{2}")
_BASIC_PLACES: Final = {
    **{"year": (0, 4), "month": (4, 6), "day": (6, 8)},
    **{"hour": (9, 11), "minute": (11, 13), "second": (13, 15)},
}
_MONTHS: Final = (
    "",
    *["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"],
)
_YEARS: Final = (1678, 2261)
"""First and last whole year that can be counted in ns from 1970."""
_PIVOT_YEAR: Final = 70
"""Years of two digits before it are of this century."""

_Place: TypeAlias = tuple[int, int]


@dataclass(frozen=True, slots=True)
class StampForm:
    """What all time stamps of a column have in common.

    Attributes
    ----------
    date : str
        The group of the date in `STAMP`.
    sign : str
        What separates its numbers, where that may be several signs.
    """

    date: str
    sign: str
    has_half: bool
    has_zone: bool

    @property
    def orders(self) -> tuple[Order, ...]:
        """The possible orders of day and month."""
        return (DAY_FIRST, MONTH_FIRST) if self.date.startswith("either") else (DAY_FIRST,)


@dataclass(frozen=True, slots=True)
class _Layout:
    """Time stamps that differ in their digits alone.

    Attributes
    ----------
    places : mapping
        First column of each number, and the one after its last.
    constants : mapping
        Numbers that are written in letters.
    """

    form: StampForm
    places: Mapping[str, _Place]
    constants: Mapping[str, int]


def find_form(text: str) -> StampForm | None:
    """Find the form of a time stamp or date; None if the text is neither."""
    layout = _find_layout(text)
    return None if layout is None else layout.form


def parse_form(texts: NDArray[np.str_], form: StampForm) -> dict[Order, NDArray[np.datetime64]]:
    """Parse time stamps of one form, in each possible order of day and month.

    What is no date or no time of day is NaT, and all from the first stamp of another form on.
    """
    parsed = {order: np.full(texts.size, "NaT", dtype="datetime64[ns]") for order in form.orders}
    for start in range(0, texts.size, _BLOCK_ROWS):
        block = np.ascontiguousarray(texts[start : start + _BLOCK_ROWS])
        letters = block.view(np.uint32).reshape(block.size, -1)
        is_digit = letters - np.uint32(ord("0")) < 10
        layouts = np.where(is_digit, np.uint32(ord("0")), letters).view(block.dtype)[:, 0]
        pending = np.ones(block.size, dtype=np.bool_)
        while pending.any():
            first = int(np.argmax(pending))
            layout = _find_layout(str(block[first]))
            if layout is None or layout.form != form:
                return parsed
            same = np.flatnonzero(pending & (layouts == layouts[first]))
            numbers = _read_numbers(letters[same], layout)
            for order, stamps in parsed.items():
                stamps[start + same] = _compute_moments(numbers, form, order)
            pending[same] = False
    return parsed


def _find_layout(text: str) -> _Layout | None:
    """Find the numbers of a time stamp or date; None if the text is neither."""
    match = STAMP.fullmatch(text) or DATE_ONLY.fullmatch(text)
    if match is None or not text.isascii():
        return None
    groups = {name: part for name, part in match.groupdict().items() if part is not None}
    date = next(name for name in _DATES if name in groups)
    sign = text[4] if date == "iso" else groups.get("sign", "")
    places = {**_find_date_places(match, date), **_find_clock_places(match)}
    is_mixed = date == "iso" and text[places["month"][1]] != sign
    is_hour_long = len(groups.get("hour", "")) > 2
    is_minute_cut = "second" not in places and len(groups.get("fraction", "")) > 1
    if is_mixed or is_hour_long or is_minute_cut:
        return None
    month = groups.get("month", "")[-8:-5].lower()
    constants = {
        "month": _MONTHS.index(month) if month in _MONTHS else 0,
        "is_afternoon": groups.get("half", "") in ("p", "P"),
        "is_west": "-" in groups.get("zone", ""),
    }
    return _Layout(StampForm(date, sign, "half" in groups, "zone" in groups), places, constants)


def _find_date_places(match: re.Match[str], date: str) -> dict[str, _Place]:
    """Find the numbers of a date; those of a basic stamp with its time of day."""
    if date == "basic":
        fraction = _BASIC_FRACTION.match(match.string)
        return _BASIC_PLACES | ({} if fraction is None else {"fraction": fraction.span("digits")})
    names = {"iso": ("year", "month", "day"), "month": ("day", "year")}
    numbers = _NUMBER.finditer(match.string, *match.span(date))
    spans = (found.span() for found in numbers)
    return dict(zip(names.get(date, ("day", "month", "year")), spans, strict=True))


def _find_clock_places(match: re.Match[str]) -> dict[str, _Place]:
    """Find the numbers of a time of day and its zone."""
    if match.re is DATE_ONLY:
        return {}
    places = {name: match.span(name) for name in _CLOCK if match[name] is not None}
    if match["fraction"] is not None:
        start, stop = match.span("fraction")
        places["fraction"] = (start + 1, stop)
    zone = _ZONE_NUMBER.finditer(match.string, *match.span("zone")) if match["zone"] else ()
    spans = (found.span() for found in zone)
    return {**places, **dict(zip(("zone_hour", "zone_minute"), spans, strict=False))}


def _read_numbers(letters: NDArray[np.uint32], layout: _Layout) -> dict[str, IntArray]:
    """Read the numbers of stamps of one layout; what is not written is zero."""
    names = ("hour", "minute", "second", "fraction", "zone_hour", "zone_minute")
    numbers = dict.fromkeys(names, np.zeros(len(letters), dtype=np.int64))
    for name, value in layout.constants.items():
        numbers[name] = np.full(len(letters), value, dtype=np.int64)
    for name, (start, stop) in layout.places.items():
        size = stop - start
        if name == "fraction":  # in ns; what is smaller is cut off
            size, stop = 9, min(stop, start + 9)
        digits = letters[:, start:stop].astype(np.int64) - ord("0")
        numbers[name] = digits @ (10 ** np.arange(size - 1, -1, -1))[: stop - start]
    return numbers


def _compute_moments(
    numbers: Mapping[str, IntArray], form: StampForm, order: Order
) -> NDArray[np.datetime64]:
    """Compute moments; one that is no date, or has no time of day, is NaT."""
    year, month, day = numbers["year"], numbers["month"], numbers["day"]
    hour, minute, second = numbers["hour"], numbers["minute"], numbers["second"]
    if order == MONTH_FIRST:
        month, day = day, month
    if form.date.endswith("short"):
        year = year + np.where(year < _PIVOT_YEAR, 2000, 1900)
    is_valid = (month >= 1) & (month <= 12) & (day >= 1) & (minute < 60) & (second <= 60)
    is_valid &= (year >= _YEARS[0]) & (year <= _YEARS[1])
    if form.has_half:
        is_valid &= (hour >= 1) & (hour <= 12)
        hour = hour % 12 + 12 * numbers["is_afternoon"]
    is_valid &= (hour < 24) & (numbers["zone_hour"] < 24) & (numbers["zone_minute"] < 60)
    months = np.where(is_valid, (year - 1970) * 12 + month - 1, 0).astype("datetime64[M]")
    days = months.astype("datetime64[D]") + np.where(is_valid, day - 1, 0)
    is_valid &= days.astype("datetime64[M]") == months  # the month has such a day
    offset = 60 * numbers["zone_hour"] + numbers["zone_minute"]
    minutes = 60 * hour + minute + np.where(numbers["is_west"], offset, -offset)
    ticks = (60 * minutes + second) * 1_000_000_000 + numbers["fraction"]
    shift = np.where(is_valid, ticks, 0).astype("timedelta64[ns]")
    moments: NDArray[np.datetime64] = days.astype("datetime64[ns]") + shift
    moments[~is_valid] = np.datetime64("NaT")
    return moments
