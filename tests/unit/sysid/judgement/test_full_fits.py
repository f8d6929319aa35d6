"""The model fitted again: to other records, to more experiments, and to both parts of a record."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.judgement.full_fits import refit, refit_experiments, refit_parts
from tests.support.library.judged_records import (
    FAST,
    FINE,
    NOISE,
    STEP,
    TIMES,
    N,
    build_context,
    draw_levels,
    draw_noise,
    draw_record,
    hold,
    make_record,
)


@pytest.mark.parametrize(("before", "after"), [(1.2, 2.2), (2.2, 4.7)])
def test_both_parts_of_a_record_are_fitted_by_themselves(before: float, after: float) -> None:
    """The lags are far apart, so no linear step leads from one estimate of both to each."""
    u = draw_levels(1)
    first, second = (
        replace(FAST, delay=delay).respond(hold(u))[::FINE] for delay in (before, after)
    )
    y = np.where(np.arange(N) < 240, first, second) + NOISE * draw_noise(1)
    context = build_context([make_record(u, y)], "fopdt", FAST.values)
    found = refit_parts(context, STEP * 240)
    assert found is not None
    size, name, *values = found.changes[0]
    assert name == "L"
    assert size > 20.0
    assert values == pytest.approx([before, after], abs=0.1)
    assert context.residual_model.without.criterion - found.criterion > 500.0


def test_a_full_fit_to_the_true_input_finds_the_truth() -> None:
    u = draw_levels(1)
    y = FAST.respond(hold(np.minimum(u, 1.2)))[::FINE] + NOISE * draw_noise(1)
    context = build_context([make_record(u, y)], "fopdt", FAST.values)
    found = refit(
        context, {"records": context.replace_input("u", lambda values: np.minimum(values, 1.2))}
    )
    assert found is not None
    assert found.criterion < context.residual_model.without.criterion
    for move in found.moves:
        assert move.stderr is not None
        assert abs(move.value - FAST.values[move.parameter]) < 4 * move.stderr


def test_a_part_of_a_record_has_samples_for_all_parameters_and_begins_at_no_outlier() -> None:
    u = draw_levels(1)
    y = FAST.respond(hold(u))[::FINE] + NOISE * draw_noise(1)
    y[200] += 20.0 * NOISE
    context = build_context([make_record(u, y)], "fopdt", FAST.values)
    assert refit_experiments(context, TIMES[200]) is None
    for few in (5, N - 5):
        assert refit_experiments(context, TIMES[few]) is None
        assert refit_parts(context, TIMES[few]) is None
    assert refit_experiments(context, TIMES[240]) is not None


def test_the_start_of_another_experiment_counts_as_a_parameter() -> None:
    record = draw_record(FAST, 1)
    context = build_context([record], "fopdt", FAST.values, initial="free")
    (u,), (y,) = record.inputs, record.outputs
    parts = [
        make_record(u.values[rows], y.values[rows], times=TIMES[rows])
        for rows in (slice(210), slice(210, None))
    ]
    apart = build_context(parts, "fopdt", FAST.values, initial="free")
    assert apart.theta.size == context.theta.size + 1
    found = refit_experiments(context, TIMES[210])
    assert found is not None
    expected = apart.residual_model.without.criterion + np.log(N)
    assert found.criterion == pytest.approx(expected, abs=0.1)
