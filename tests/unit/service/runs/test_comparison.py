"""When two estimates of one name are told apart."""

import pytest

from service.runs.comparison import find_furthest_pair
from sysid.core.text import find_shown_error, format_interval, join_estimate, plain_estimate
from sysid.uncertainty.estimates import Estimate


def make_estimate(value: float, stderr: float | None) -> Estimate:
    ends = None if stderr is None else (value - 2 * stderr, value + 2 * stderr)
    return Estimate("L", "s", value, 0.0, 10.0, stderr, ends, "identified")


def test_intervals_that_meet_tell_nothing_apart() -> None:
    assert find_furthest_pair([make_estimate(1.0, 0.1), make_estimate(1.3, 0.1)]) is None
    assert find_furthest_pair([make_estimate(1.0, 0.1), make_estimate(9.0, None)]) is None


def test_of_several_the_two_furthest_apart_are_named() -> None:
    three = [make_estimate(1.0, 0.01), make_estimate(1.5, 0.01), make_estimate(1.2, 0.01)]
    assert find_furthest_pair(three) == (0, 1)


@pytest.mark.parametrize(
    ("value", "stderr", "text"),
    [
        (0.2213, 0.0021, "0.2213 ± 0.0021"),
        (0.159, 0.0047, "0.1590 ± 0.0047"),
        (3.0, 0.0997, "3.00 ± 0.10"),
        (12345.0, 250.0, "12345 ± 250"),
        (0.5, None, "0.5"),
    ],
)
def test_values_are_cut_at_the_second_digit_of_their_error(
    value: float, stderr: float | None, text: str
) -> None:
    assert plain_estimate(value, stderr) == text


def test_a_bound_is_not_rounded_to_the_error_of_its_estimate() -> None:
    assert plain_estimate(0.2, 835.0) == "0 ± 835"
    assert plain_estimate(0.2, 835.0, status="at bound") == "0.2"
    assert join_estimate(-0.2, 835.0, status="at bound") == "−0.2"


def test_an_estimate_at_its_bound_or_of_a_search_that_did_not_settle_has_no_error() -> None:
    for status in ("at bound", "not settled"):
        assert find_shown_error(0.1, status) is None
        assert format_interval((0.1, 0.2), 0.05, status=status) == ""
    assert find_shown_error(0.1, "dependent") == 0.1
    assert plain_estimate(0.0937, 0.0072, status="not settled") == "0.0937"
    assert join_estimate(-0.0937, 0.0072, status="not settled") == "−0.0937000"
