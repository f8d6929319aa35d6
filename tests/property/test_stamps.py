"""Date stamps are read as `datetime` writes them, in whatever layouts one column mixes."""

from datetime import datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.formats.tabular.time_columns import parse_stamps
from sysid.core.errors import UnreadableFile
from tests.support.profiles import scale_examples

FORMS = (
    *("%Y-%m-%dT%H:%M:%S.%f", "%Y/%m/%d %H:%M:%S,%f", "%Y%m%dT%H%M%S.%f"),
    *("%d.%m.%Y %H:%M:%S.%f", "%d.%m.%y, %H:%M:%S.%f"),
    *("%d-%b-%Y %H:%M:%S.%f", "%d-%b-%Y %I:%M:%S.%f %p"),
)
FIRST, LAST = map(datetime.fromisoformat, ("1970-01-01", "2068-12-31"))
MOMENTS = st.datetimes(FIRST, LAST)


def parse(texts: list[str]) -> tuple[list[datetime], bool]:
    stamps, is_utc = parse_stamps(np.array(texts), np.arange(len(texts)) + 2, "t", [])
    return stamps.astype("datetime64[us]").tolist(), is_utc


@given(st.sampled_from(FORMS), st.lists(MOMENTS, min_size=1, max_size=20))
@settings(max_examples=scale_examples(60))
def test_stamps_are_the_moments_that_were_written(form: str, moments: list[datetime]) -> None:
    assert parse([moment.strftime(form) for moment in moments]) == (moments, False)


@given(st.lists(MOMENTS, min_size=1, max_size=20), st.data())
@settings(max_examples=scale_examples(60))
def test_zeros_fractions_and_zones_may_differ_from_row_to_row(
    moments: list[datetime], data: st.DataObject
) -> None:
    texts, expected = [], []
    for moment in moments:
        digits, minutes = data.draw(st.integers(0, 6)), data.draw(st.integers(-1439, 1439))
        sign, offset = "-" if minutes < 0 else "+", abs(minutes)
        fraction = f".{moment.microsecond:06}"[: digits + 1] if digits else ""
        zero = data.draw(st.sampled_from(["", "0"]))
        hour = f"{moment.hour:{zero and '02'}}"
        zone = f"{sign}{offset // 60:02}:{offset % 60:02}"
        texts.append(
            f"{moment.year}-{moment.month}-{moment.day} {hour}:{moment:%M:%S}{fraction}{zone}"
        )
        kept = 10 ** (6 - digits)
        rounded = moment.replace(microsecond=moment.microsecond // kept * kept)
        expected.append(rounded - timedelta(minutes=minutes))
    assert parse(texts) == (expected, True)


@pytest.mark.parametrize(
    "text",
    [
        *("2026-02-29 10:00:00", "2026-13-01 10:00:00", "2026-01-01 24:00:00"),
        *("2026-01-01 10:60:00", "2026-01-01 10:00:00Z", "2026/01/01 10:00:00"),
        *("9999-12-31 00:00:00", "2026-01-01 10:00.5", "nan"),
    ],
)
def test_what_is_no_moment_or_of_another_form_is_refused_at_its_row(text: str) -> None:
    with pytest.raises(UnreadableFile, match="row 3, column 't'"):
        parse(["2026-01-01 10:00:00", text, "2026-01-01 10:00:02"])


@pytest.mark.parametrize(("year", "full"), [("00", 2000), ("69", 2069), ("70", 1970), ("99", 1999)])
def test_a_year_of_two_digits_is_of_the_nearest_century(year: str, full: int) -> None:
    assert parse([f"01.02.{year} 10:00:00"])[0] == [
        datetime.fromisoformat(f"{full}-02-01T10:00:00")
    ]
