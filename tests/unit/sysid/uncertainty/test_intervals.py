"""When an interval says little more than the bounds of its parameter."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.settings import Loss
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.language.functions import Interval
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.intervals import keep_in_bounds, mark_poor_intervals
from tests.support.library.search_problems import example
from tests.support.library.small_models import LINE

PROBLEM = example(n=80)
ESTIMATE = replace(
    analyse_estimate(
        PROBLEM,
        PROBLEM.evaluator.lower + 0.4 * (PROBLEM.evaluator.upper - PROBLEM.evaluator.lower),
    ).estimates[0],
    status="identified",
    reason="",
)


def mark_interval(lower: float, upper: float, scale: str, interval: Interval) -> tuple[str, str]:
    """Status and reason of an estimate with these bounds and this interval."""
    bounds = {"lower": lower, "upper": upper, "scale": scale}
    problem = PROBLEM.rebuild(parameters={ESTIMATE.name: bounds})
    marked, other = mark_poor_intervals(
        problem.free_parameters,
        (replace(ESTIMATE, interval95=interval), replace(ESTIMATE, interval95=None)),
    )
    assert other.status == "identified"
    return marked.status, marked.reason.removeprefix("these data determine it poorly: ")


@pytest.mark.parametrize(
    ("lower", "upper", "scale", "interval", "reason"),
    [
        (0.0, 30.0, "linear", (-4.0, 16.0), "its 95 % interval contains 0, and 53 % of its range"),
        (-40.0, 40.0, "linear", (-14.0, 20.0), "its 95 % interval contains 0, and 42 % of its"),
        (5.0, 15.0, "linear", (2.0, 12.5), "its 95 % interval is wider than its range"),
        (0.01, 100.0, "log", (-1.0, 1.0), "its 95 % interval contains 0, and 50 % of its range"),
        (0.0, 60.0, "linear", (-4.0, 16.0), ""),  # less than a third of it
        (5.0, 15.0, "linear", (6.0, 14.0), ""),  # its size is known
        (0.01, 100.0, "log", (-1.0, 0.1), ""),
    ],
)
def test_an_interval_around_zero_that_covers_much_of_the_range_says_little(
    lower: float, upper: float, scale: str, interval: Interval, reason: str
) -> None:
    status, found = mark_interval(lower, upper, scale, interval)
    assert status == ("unidentifiable" if reason else "identified")
    assert found.startswith(reason) if reason else not found


@pytest.mark.parametrize(
    ("physical", "interval", "status"),
    [
        (None, (7.0, 18.0), "unidentifiable"),
        ("upper", (7.0, 18.0), "identified"),
        ("lower", (7.0, 18.0), "unidentifiable"),
        ("lower", (2.0, 13.0), "identified"),
        ("both", (2.0, 18.0), "unidentifiable"),
    ],
)
def test_what_lies_beyond_a_physical_limit_does_not_make_an_interval_wide(
    physical: str | None, interval: Interval, status: str
) -> None:
    change: dict[str, Any] = {"lower": 5.0, "upper": 15.0}
    change |= {"physical": physical} if physical else {}
    problem = PROBLEM.rebuild(parameters={ESTIMATE.name: change})
    wide = replace(ESTIMATE, interval95=interval)
    (marked,) = mark_poor_intervals(problem.free_parameters, [wide])
    assert marked.status == status


def test_an_interval_of_one_degree_of_freedom_is_not_identified_and_stays_in_the_bounds() -> None:
    """The standard error is small beside the range, but the residuals are a single drift."""
    times = 0.1 * np.arange(200)
    u = times / times[-1]
    drift = 0.2 * np.sin(3.0 * np.pi * u)
    noise = 0.002 * np.random.default_rng(1).standard_normal(200)
    record = Record(
        (Channel("u", times, u),), (Channel("y", times, 2.0 * u + 1.0 + drift + noise),)
    )
    bounds = {"a": {"lower": 1.0, "upper": 3.0}}
    found = identify(LINE, record, parameters=bounds, loss=Loss(noise_model="white"))
    slope = found["a"]
    assert found.degrees < 1.1
    assert slope.stderr is not None
    assert slope.stderr < 0.2 * (slope.upper - slope.lower)
    assert (slope.status, slope.interval95) == ("unidentifiable", (1.0, 3.0))
    assert slope.reason.endswith("its 95 % interval is wider than its range")


def test_an_interval_that_a_bound_cuts_says_so() -> None:
    inside = Estimate("T", "s", 0.5, 0.0, 5.0, 0.01, (0.48, 0.52), "identified")
    cut = replace(inside, interval95=(-0.1, 5.2))
    kept, shown = keep_in_bounds([inside, cut])
    assert kept == inside
    assert shown.interval95 == (0.0, 5.0)
    assert shown.reason == "its 95 % interval is cut at the lower bound 0 and the upper bound 5"
