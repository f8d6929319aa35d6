"""Sides of switches in time: what jumps or bends with t and parameters alone."""

import numpy as np
import pytest

from sysid.language.checker import check_expression
from sysid.language.evaluation import evaluate_signal
from sysid.language.printer import format_expression
from sysid.language.scope import Scope
from sysid.language.time_switches import list_sides
from sysid.language.tree import Expression

SCOPE = Scope(
    "differential", states=("x",), inputs=("u",), parameters={"a": (0.0, 1.0), "L": (0.0, 1.0)}
)


def tree(written: str) -> Expression:
    found = check_expression(written, SCOPE)
    assert found.faults == ()
    assert found.tree is not None
    return found.tree


@pytest.mark.parametrize(
    ("written", "sides"),
    [
        ("where(t > a, x, u)", ["t > a"]),
        ("where(not (t >= a and t < 2*a or x > 0), t, 0)", ["t >= a", "t < 2*a"]),
        ("max(t - a, 0)", ["t - a > 0"]),
        ("max(t - a, 0, x)", ["t - a > 0"]),
        ("min(t, a, 3)", ["min(t, a) > 3", "t > a"]),
        ("clip(t, a, 2*a)", ["t > a", "t > 2*a"]),
        ("sign(t - a)", ["t - a > 0", "t - a < 0"]),
        ("abs(sin(t))", ["sin(t) > 0", "sin(t) < 0"]),
        ("where(t > a, 1, 0)*where(t > a, 2, 0)", ["t > a"]),
    ],
)
def test_each_jump_and_bend_has_its_sides(written: str, sides: list[str]) -> None:
    found = [format_expression(side) for side in list_sides([tree(written)])]
    assert found == [f"where({side}, 1, 0)" for side in sides]


def test_whole_numbers_and_remainders_are_sides_themselves() -> None:
    found = [format_expression(one) for one in list_sides([tree("floor(t/a)"), tree("mod(t, a)")])]
    assert found == ["floor(t/a)", "floor((t - mod(t, a))/a + 0.5)"]


def test_the_side_of_a_remainder_changes_exactly_where_it_begins_anew() -> None:
    remainder = tree("mod(t, 0.1)")
    times = np.linspace(0.0, 10.0, 100_001)
    (side,) = (evaluate_signal(one, times) for one in list_sides([remainder]))
    rest = evaluate_signal(remainder, times)
    np.testing.assert_array_equal(np.diff(side), np.diff(rest) < 0)


@pytest.mark.parametrize(
    "written",
    [
        "exp(-t/a)*sin(t)",
        "where(x > a, t, 0)",
        "where(u > t, 1, 0)",
        "where(x(t - L) > t, 1, 0)",
        "max(x, t) + sign(x - t) + abs(u) + floor(x) + mod(x, t) + table(u, [0, 1], [0, 1])",
        "table(t - a, [1, 3], [0, a])*pchip(t, [1, 2], [0, 1])",
        "where(a > 0.5, 1, 0)*max(a, 0.2)",
        "where(t == a, 1, 0) + where(t != a, 1, 0)",
    ],
)
def test_what_is_smooth_constant_or_depends_on_signals_has_none(written: str) -> None:
    assert list_sides([tree(written)]) == ()
