"""A held input that switches between its samples: the lag with it is the true one."""

import numpy as np
import pytest

from sysid.judgement.explanations import switches
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
    make_record,
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


def test_what_moves_in_a_gap_of_the_stamps_is_no_early_switch() -> None:
    first, second = (CASE.draw(FAST, seed) for seed in (1, 2))
    (u,), (y,) = second.inputs, second.outputs
    jumps = np.flatnonzero(np.diff(u.values)) + 1
    last = int(jumps[jumps.size // 2])
    late = np.where(np.arange(u.times.size) >= last, 500.0, 0.0)
    gapped = make_record(u.values, y.values, times=u.times + late)
    (found,) = switches.propose(build_context([first, gapped], "fopdt", FAST.values))
    (moved,) = found.change["records"][1].inputs
    is_earlier = moved.times < gapped.inputs[0].times
    assert is_earlier[jumps[jumps != last]].sum() > 0.9 * (jumps.size - 1)
    assert not is_earlier[last]


def test_responses_of_changes_are_solved_as_a_dense_matrix() -> None:
    random, groups, dense = np.random.default_rng(3), [], np.zeros((30, 9))
    for number in range(3):  # each group shares rows with the next one, and with no other
        rows, own = slice(8 * number, 8 * number + 14), slice(3 * number, 3 * number + 3)
        dense[rows, own] = random.normal(size=(14, 3))
        groups.append([(slice(0, 0), np.zeros((0, 3))), (rows, dense[rows, own])])
    responses = switches._Responses(30, groups)
    right, ridged = random.normal(size=(9, 2)), dense.T @ dense + 0.1 * np.eye(9)
    solved, spread = responses.solve(0.1, right)
    np.testing.assert_allclose(solved, np.linalg.solve(ridged, right))
    assert spread == pytest.approx(np.linalg.slogdet(ridged)[1])
    np.testing.assert_allclose(responses.respond(right[:, 0]), dense @ right[:, 0])
    np.testing.assert_allclose(responses.project(dense), dense.T @ dense, atol=1e-12)
    assert responses.largest >= np.linalg.norm(dense, 2) ** 2


def test_of_too_many_changes_the_first_ones_count(monkeypatch: pytest.MonkeyPatch) -> None:
    context = build_context([CASE.draw(FAST, 1)], "fopdt", FAST.values)
    monkeypatch.setattr(switches, "_MOST_PRODUCTS", 10**2 * context.times.size)
    monkeypatch.setattr(switches, "_FEWEST_IN_GROUP", 1)
    (found,) = switches.propose(context)
    (u,), (moved,) = context.problem.records[0].inputs, found.change["records"][0].inputs
    jumps = np.flatnonzero(np.diff(u.values)) + 1
    early = (u.times - moved.times)[jumps] / STEP
    np.testing.assert_allclose(early[10:], 0.5)
    assert np.std(early[:10]) > 0.05
