"""Trends as text: which runs are in no table, and why."""

from typing import Any

import pytest

from service.trends.trend_text import list_notes

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
