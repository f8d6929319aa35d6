"""A held input that switches between its samples: the lag with it is the true one."""

import numpy as np
import pytest

from sysid.judgement.judge import explain_residuals
from tests.support.library.defects import READING
from tests.support.library.judged_records import (
    FAST,
    PLANTS,
    STEP,
    Process,
    build_context,
    draw_levels,
    draw_record,
)

(CASE,) = (one for one in READING if one.explanations == ("switches between samples",))


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.model)
def test_with_early_switches_the_lag_is_known_to_a_share_of_a_period(plant: Process) -> None:
    for seed in range(1, 4):
        context = build_context([CASE.draw(plant, seed)], plant.model, plant.values)
        first = explain_residuals(context).findings[0]
        assert first.explanation == "switches between samples"
        (lag,) = (move for move in first.moves if move.parameter == "L")
        changes = np.count_nonzero(np.diff(draw_levels(seed)))
        known = STEP / np.sqrt(12.0 * changes)
        assert abs(lag.value - plant.delay) < 3.0 * np.hypot(known, lag.stderr or 0.0)
        estimate = dict(zip(context.problem.free_names, context.theta, strict=True))
        assert estimate["L"] < plant.delay - 0.1, "most of half a period too small"


def test_a_sound_record_has_no_early_switches() -> None:
    for seed in range(3):
        record = draw_record(FAST, seed, pole=0.9)
        assert explain_residuals(build_context([record], "fopdt", FAST.values)).findings == ()
