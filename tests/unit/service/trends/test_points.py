"""Points of a trend: which runs make one, and how sure it is."""

from math import pi, sqrt
from typing import Any

import pytest

from service.repositories.trend_rows import TrendRow
from service.trends.points import (
    build_quantities,
    group_by_label,
    read_onset_estimates,
    to_label_out,
)
from sysid.core.findings import EstimateStatus, Finding, note
from sysid.residuals.onset_delay import OnsetDelay
from sysid.results.result import Agreements
from sysid.uncertainty.estimates import Estimate


def make_row(run: str, x: float, cell: dict[str, Any] | None = None, **values: Any) -> TrendRow:
    known = {
        "number": 0,
        "labels": {"x": x},
        "evaluations": 10,
        "best_rms": 0.5,
        "parameters": (),
        "onset_delays": (),
        "agreement": Agreements((), ()),
        "findings": (),
        "warnings": (),
        "noise_model": "white",
    }
    return TrendRow(**{**known, **values, "id": run, "cell": cell or {}})


def make_parameter(
    value: float,
    stderr: float | None,
    status: EstimateStatus = "identified",
    lower: float = 0.0,
    upper: float = 1.0,
) -> Estimate:
    return Estimate("L", "s", value, lower, upper, stderr, None, status)


def onset(delay: float | None, spread: float | None, events: int) -> OnsetDelay:
    return OnsetDelay(0, "u", "y", delay, spread, events)


def chosen(*rows: TrendRow) -> dict[float, list[str]]:
    return {x: [one.id for one in many] for x, many in group_by_label(rows, "x").items()}


def test_of_runs_on_the_same_data_the_best_is_taken_wherever_it_stands() -> None:
    worst, best, unknown = (
        make_row(run, 2.0, {"/seed": seed}, best_rms=rms)
        for run, seed, rms in (("worst", 1, 0.9), ("best", 2, 0.1), ("unknown", 3, None))
    )
    for order in ([worst, best, unknown], [best, unknown, worst], [unknown, worst, best]):
        assert chosen(*order) == {2.0: ["best"]}


def test_runs_on_other_data_and_at_other_labels_are_points_of_their_own() -> None:
    rows = [
        make_row("far", 8.0, {"/noise/seed": 1, "/seed": 1}, best_rms=0.01),
        make_row("first", 2.0, {"/noise/seed": 1, "/seed": 1}, best_rms=0.5),
        make_row("second", 2.0, {"/noise/seed": 2, "/seed": 1}, best_rms=0.1),
        make_row("third", 2.0, {"/datasets": ["ds_2"], "/seed": 1}, best_rms=0.2),
    ]
    assert chosen(*rows) == {2.0: ["first", "second", "third"], 8.0: ["far"]}


def test_runs_of_one_label_are_weighted_by_their_errors() -> None:
    precise = make_row(
        "a", 2.0, {"/noise/seed": 1}, parameters=[make_parameter(0.1, 0.01, upper=0.5)]
    )
    vague = make_row(
        "b", 2.0, {"/noise/seed": 2}, parameters=[make_parameter(0.13, 0.02, lower=-1.0)]
    )
    fixed = make_row("c", 4.0, parameters=[make_parameter(0.3, None, "at bound")])
    (quantity,) = build_quantities(group_by_label([precise, vague, fixed], "x"), [])
    pooled, alone = quantity.points
    assert pooled.estimate is not None
    assert pooled.value == pytest.approx((4 * 0.1 + 0.13) / 5)
    # χ² = (0.006/0.01)² + (0.024/0.02)² = 1.8 of one degree: the errors grow by its root.
    assert quantity.between_runs == pytest.approx(sqrt(1.8))
    assert pooled.estimate.stderr == pytest.approx(0.01 / sqrt(1.25) * sqrt(1.8))
    assert (alone.estimate, alone.value, alone.status) == (None, 0.3, "at bound")
    assert quantity.bounds == (-1.0, 1.0)


def test_parameters_that_were_not_estimated_are_no_quantities_unless_named() -> None:
    rows = [make_row("a", 2.0, parameters=[make_parameter(0.1, None, "fixed")])]
    assert build_quantities(group_by_label(rows, "x"), []) == []
    (named,) = build_quantities(group_by_label(rows, "x"), ["L"])
    assert named.points[0].value == 0.1


def test_the_error_of_an_onset_delay_is_that_of_a_median() -> None:
    found = read_onset_estimates([onset(0.5, 0.08, 16)])
    error = sqrt(pi / 2) * 0.08 / 4  # of a median of normally distributed events
    assert found["onset delay"] == pytest.approx((0.5, error), rel=1e-4)


def test_onset_delays_of_several_experiments_are_averaged_with_their_errors() -> None:
    found = read_onset_estimates([onset(0.4, 0.08, 16), onset(0.6, 0.06, 9), onset(None, None, 0)])
    errors = [sqrt(pi / 2) * 0.02, sqrt(pi / 2) * 0.02]
    assert found["onset delay"] == pytest.approx((0.5, sqrt(sum(e**2 for e in errors)) / 2), 1e-4)
    assert read_onset_estimates([onset(0.4, 0.08, 16), onset(0.6, 0.06, 1)]) == {}


def test_findings_that_are_no_notes_are_the_flags_of_a_label() -> None:
    bound = Finding("bound", "identifiability", "caution", "L lies at its bound", "L lies at 0 s.")
    remark = note("ridge", "identifiability", "T and L are not separable")
    rows = [
        make_row(run, 2.0, findings=(bound, remark), warnings=(bound.text, remark.text))
        for run in "ab"
    ]
    told = to_label_out(2.0, rows, {}, {}, {})
    assert told.flags == ["L lies at its bound"]
    assert told.warnings == ["L lies at 0 s.", "T and L are not separable"]
