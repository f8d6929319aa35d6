"""Trends as text: which runs are in no table, and why."""

from typing import Any

import pytest

from service.trends.trend_text import list_flags, list_notes

EMPTY: dict[str, Any] = {"x": "length_m", "quantities": [], "labels": [], "notes": []}


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ({"missing": 0, "failed": 0, "unended": 0}, []),
        (
            {"missing": 120, "failed": 1, "unended": 1},
            [
                "Runs that are not in the table: 1 failed, 1 has not ended, "
                "118 were cancelled or deleted"
            ],
        ),
        (
            {"missing": 3, "failed": 0, "unended": 2},
            ["Runs that are not in the table: 2 have not ended, 1 was cancelled or deleted"],
        ),
    ],
)
def test_runs_that_are_not_in_the_table_are_counted_by_reason(
    counts: dict[str, int], said: list[str]
) -> None:
    assert list_notes({**EMPTY, **counts}) == said


def test_flags_are_what_speaks_against_runs_and_what_stands_out() -> None:
    drift = {"kind": "run", "drifted": True, "z": 4.2, "limit": 2.6}
    point = {
        "x": 5.0,
        "status": "at bound",
        "is_outlier": True,
        "p_value": 0.001,
        "drifts": [drift],
    }
    quantity = {"name": "L", "points": [point, {**point, "x": 9.0}]}
    place = {"x": 5.0, "flags": ["L lies at its bound"], "warnings": ["T and L are not separable"]}
    assert list_flags(place, [quantity]) == [
        "L lies at its bound",
        "L outlier (p = 0.001)",
        "L drifted from the reference (z = +4.2, limit 2.6)",
    ]
    calm = {**place, "x": 7.0, "flags": []}
    assert list_flags(calm, [quantity]) == []
