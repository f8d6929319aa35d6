import math
from datetime import UTC, datetime, timedelta

import pytest

from service.core.label_text import format_age, format_count, format_duration
from service.pages.result_filters import format_delay_text, format_share
from sysid.core.text import (
    format_estimate,
    format_interval,
    format_number,
    format_p_value,
    format_unit,
)
from sysid.results.parts import OrderFit


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.42, "0.4200"),
        (10.4912, "10.49"),
        (12345.6, "12346"),
        (0.0, "0"),
        (-0.5, "−0.5000"),
        (None, "–"),
        (float("inf"), "–"),
        (1.5e-7, "1.500·10⁻⁷"),
        (2.5e9, "2.500·10⁹"),
    ],
)
def test_a_number_has_four_significant_digits(value: float | None, text: str) -> None:
    assert format_number(value) == text


@pytest.mark.parametrize(
    ("value", "stderr", "texts"),
    [
        (0.119324, 0.00041, ("0.11932", "0.00041")),
        (12.3456, 1.5, ("12.3", "1.5")),
        (0.5, 0.0996, ("0.50", "0.10")),
        (1234.6, 77.0, ("1235", "77")),
        (0.5, None, ("0.500000", "")),
        (1.0, 0.0, ("1.00000", "")),
    ],
)
def test_an_estimate_ends_where_its_error_does(
    value: float, stderr: float | None, texts: tuple[str, str]
) -> None:
    assert format_estimate(value, stderr) == texts


NOT_FINITE = (math.nan, math.inf, -math.inf)


@pytest.mark.parametrize("value", NOT_FINITE)
def test_what_is_not_finite_is_a_dash(value: float) -> None:
    assert format_estimate(value, 0.0065) == ("–", "")
    assert format_estimate(value, None, status="at bound") == ("–", "")
    assert format_interval((value, 3.0531), 0.0065) == "– … 3.0531"
    assert format_interval((value, math.nan), 0.0065) == "–"
    assert format_count(value) == "–"
    assert format_share(value) == "–"
    assert format_p_value(value) == "–"


@pytest.mark.parametrize(("delay", "text"), [(math.nan, "–"), (0.5, "0.5000 ± 0.0065 s")])
def test_a_dead_time_has_a_unit_only_with_a_number(delay: float, text: str) -> None:
    fit = OrderFit("fopdt", 1, delay, 0.0065, values={}, rms=0.1, bic=0.0)
    assert format_delay_text(fit, "s") == text


def test_an_interval_has_the_digits_of_the_error() -> None:
    assert format_interval((0.11851, 0.12012), 0.0004) == "0.11851 … 0.12012"
    assert format_interval(None, 0.1) == ""


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0184, "18.4 ms"), (3.14159, "3.14 s"), (61, "1 min 1 s"), (3700, "1 h 1 min"), (None, "–")],
)
def test_a_duration_has_the_unit_that_suits_it(seconds: float | None, text: str) -> None:
    assert format_duration(seconds).replace("\u202f", " ") == text


@pytest.mark.parametrize(
    ("ago", "text"),
    [
        (timedelta(seconds=5), "5 s"),
        (timedelta(minutes=3, seconds=50), "3 min"),
        (timedelta(hours=30), "1 d"),
        (timedelta(seconds=-4), "0 s"),
    ],
)
def test_an_age_is_told_in_its_largest_unit(ago: timedelta, text: str) -> None:
    now = datetime(2026, 1, 1, tzinfo=UTC)
    assert format_age(now - ago, now).replace("\u202f", " ") == text


def test_large_counts_are_grouped_and_units_of_pure_numbers_are_not_written() -> None:
    assert format_count(1234567).replace("\u202f", " ") == "1 234 567"
    assert format_unit("1") == ""
    assert format_unit("kPa").strip() == "kPa"
