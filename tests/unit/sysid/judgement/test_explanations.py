"""A record with a defect is explained by its name, on two plants; a sound record by nothing."""

import re
from dataclasses import replace

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.judgement.explanations import constancy, history, reading
from sysid.judgement.judge import explain_residuals
from sysid.judgement.levels import DEFECT_GAIN
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from tests.support.library.defects import (
    ACTUATOR,
    CONSTANCY,
    HISTORY,
    LATE,
    LOADS,
    NOISES,
    READING,
    SENSOR,
    STRUCTURE,
    DefectCase,
)
from tests.support.library.judged_records import (
    FAST,
    FINE,
    NOISE,
    PLANTS,
    SLOW,
    TIMES,
    N,
    Process,
    build_context,
    draw_levels,
    draw_noise,
    draw_record,
    explain,
    explain_input,
    explain_output,
    hold,
    list_names,
    make_record,
)
from tests.support.profiles import draw_seeds

CASES = (*CONSTANCY, *SENSOR, *ACTUATOR, *LOADS, *READING, *HISTORY, *STRUCTURE, *NOISES)


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.model)
@pytest.mark.parametrize("pole", [0.0, 0.7, 0.95])
def test_nothing_is_found_in_a_sound_record_with_noise_of_any_colour(
    plant: Process, pole: float
) -> None:
    for seed in draw_seeds(gate=2, night=30):
        explained = explain(plant, draw_record(plant, seed, pole=pole))
        assert explained.findings == ()
        assert explained.is_done


@pytest.mark.parametrize(
    ("case", "plant"),
    [
        pytest.param(case, plant, id=f"{case.name}, {plant.model} {number}")
        for case in CASES
        for number, plant in enumerate(case.plants)
    ],
)
def test_a_defect_is_found_by_its_name(case: DefectCase, plant: Process) -> None:
    first = explain(plant, case.draw(plant, case.seed)).findings[0]
    assert first.explanation in case.explanations
    assert first.gain is not None
    assert first.gain > DEFECT_GAIN
    assert first.text.endswith(".")
    assert (first.severity == "caution") == bool(first.parameters)
    doubtful, moved = {*first.parameters}, {move.parameter for move in first.moves}
    assert doubtful <= moved or doubtful > moved, "those that move, or all, starts included"
    sizes = [abs(move.stderrs) for move in first.moves]
    assert sizes == sorted(sizes, reverse=True)


LAG_CHANGES = CONSTANCY[2]
OTHER = replace(FAST, gain=-3.0, times=(6.0,))
CHANGED = (("K", "K"), ("T", "T1"), ("L", "L"), ("K", "K"), ("L", "L"))
"""What changes in each case of constancy, in both plants."""


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.model)
def test_clocks_jump_where_no_lag_is_estimated(plant: Process) -> None:
    record = LAG_CHANGES.draw(plant, 1)
    explained = explain(plant, record, parameters={"L": {"fixed": plant.delay}})
    assert list_names(explained)[0] == "jump of a clock"
    assert explained.findings[0].family == "clocks"


def explain_start(plant: Process, first: float, seed: int) -> list[str]:
    """Explain a record of a plant at rest whose input begins so far from 0, where x starts."""
    model = parse_model({**load_model("fopdt").document, "initial": {"x": 0}})
    u = draw_levels(seed)
    u = u - u[0] + first
    y = plant.respond(hold(u))[::FINE] + NOISE * draw_noise(seed)
    explained = explain_residuals(build_context([make_record(u, y)], model, plant.values))
    assert not explained.findings or "initial: free" in explained.findings[0].advice
    return list_names(explained)


@pytest.mark.parametrize("plant", [FAST, OTHER], ids=["faster", "slower"])
def test_a_start_that_the_model_fixes_wrongly_is_named(plant: Process) -> None:
    for seed in (1, 2, 3):
        assert explain_start(plant, 0.15, seed)[0] == "start"
        assert explain_start(plant, 0.0, seed) == []


def test_a_start_that_is_far_off_is_named() -> None:
    assert [explain_start(OTHER, 1.0, seed)[0] for seed in (1, 2, 3)] == 3 * ["start"]


def test_the_moment_of_a_change_is_named_and_both_values() -> None:
    first = explain(FAST, CONSTANCY[1].draw(FAST, 3)).findings[0]
    assert re.fullmatch(r"T changes at about 11[45](\.5)? s", first.brief)
    before, after = read_both_values(first.text)
    assert before == pytest.approx(3.0, rel=0.2)
    assert after == pytest.approx(4.8, rel=0.2)


def read_both_values(text: str) -> tuple[float, float]:
    found = re.search(r"T from ([\d.]+\d) to ([\d.]+\d)", text)
    assert found is not None
    return float(found[1]), float(found[2])


def test_a_text_has_one_value_before_a_change() -> None:
    first = explain(FAST, CONSTANCY[1].draw(FAST, 3)).findings[0]
    value = next(move.value for move in first.moves if move.parameter == "T")
    assert value in [pytest.approx(one, rel=1e-3) for one in read_both_values(first.text)]


@pytest.mark.parametrize(
    ("case", "plant", "name"),
    [
        pytest.param(case, plant, name, id=f"{case.name}, {plant.model}")
        for case, names in zip(CONSTANCY, CHANGED, strict=True)
        for plant, name in zip(PLANTS, names, strict=True)
    ],
)
def test_a_parameter_that_changes_is_not_identified(
    case: DefectCase, plant: Process, name: str
) -> None:
    findings = explain(plant, case.draw(plant, 1)).findings
    assert name in {parameter for one in findings for parameter in one.parameters}


@pytest.mark.parametrize(("plant", "seed"), [(FAST, 1), (FAST, 2), (SLOW, 1)])
def test_a_missing_time_constant_is_no_fault_of_exact_records(plant: Process, seed: int) -> None:
    (case,) = STRUCTURE
    first = explain(plant, case.draw(plant, seed)).findings[0]
    assert first.family == "structure"


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.model)
def test_a_unit_that_jumps_far_leaves_no_trust(plant: Process) -> None:
    """Its residuals are so large that errors hide every move: only the gain tells."""
    u = draw_levels(1)
    y = plant.respond(hold(u))[::FINE] + NOISE * draw_noise(1)
    found = explain(plant, make_record(u, np.where(LATE, 1.8 * y + 32.0, y)))
    assert found.findings[0].gain is not None
    assert found.findings[0].gain > 1000
    assert not found.is_noise


def test_each_experiment_is_named() -> None:
    sound, changed = draw_record(FAST, 1), SENSOR[1].draw(FAST, 2)
    first = explain(FAST, sound, changed).findings[0]
    assert "of experiment 2" in first.brief


@pytest.mark.parametrize("seed", draw_seeds(gate=2, night=10))
def test_a_sensor_at_its_limit_is_not_said_to_repeat_old_readings(seed: int) -> None:
    explained = explain_output(FAST, seed, lambda y: np.minimum(y, np.quantile(y, 0.7)))
    assert list_names(explained)[0] == "limit of a sensor"
    assert "repeated reading" not in list_names(explained)
    assert all("old readings" not in one.text for one in explained.findings)


@pytest.mark.parametrize("seed", draw_seeds(gate=2, night=10))
def test_an_actuator_at_its_limit_is_told_once(seed: int) -> None:
    explained = explain_input(FAST, seed, lambda u: np.minimum(u, 1.0))
    briefs = [one.brief for one in explained.findings]
    assert len(briefs) == len(set(briefs))


def test_a_change_is_not_looked_for_where_a_record_begins() -> None:
    record = draw_record(FAST, 1)
    shocked = record.outputs[0].values.copy()
    shocked[[2, 150]] += 5.0
    context = build_context(
        [replace(record, outputs=(replace(record.outputs[0], values=shocked),))],
        FAST.model,
        FAST.values,
    )
    assert {2, 150} <= set(context.find_shocks())
    moments = [moment for moment, *_ in context.find_late(np.ones(context.times.size))]
    assert context.times[150] in moments
    assert context.times[2] not in moments


def test_an_offset_of_the_output_changes_as_its_sensor_does() -> None:
    context = build_context([draw_record(FAST, 1)], "fopdt", FAST.values)
    briefs = [one.brief for one in constancy.propose(context)]
    assert any(brief.startswith("K changes") for brief in briefs)
    assert not any(brief.startswith("y0") for brief in briefs)


@pytest.mark.parametrize("is_regular", [True, False])
def test_means_have_periods_so_irregular_samples_are_none(is_regular: bool) -> None:
    u = draw_levels(1)
    uneven = np.sort(np.random.default_rng(1).uniform(0.0, TIMES[-1], N))
    record = make_record(u, FAST.respond(hold(u))[::FINE], times=TIMES if is_regular else uneven)
    context = build_context([record], "fopdt", FAST.values)
    settings = [one.setting for one in reading.propose(context)]
    expected = ["Use hold: {u: first}.", "Use hold: {u: mean}.", "", "Use hold: {y: mean-after}."]
    assert settings == ([*expected, "Use hold: {y: mean}."] if is_regular else ["", ""])


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.model)
def test_a_sensor_that_is_stuck_for_a_short_time_is_named(plant: Process) -> None:
    def stick(y: FloatArray) -> FloatArray:
        return np.where((np.arange(N) >= 100) & (np.arange(N) < 116), y[100], y)

    found = explain_output(plant, 1, stick).findings
    assert found[0].explanation == "repeated reading"


def test_outliers_at_the_end_are_no_variance_that_follows_time() -> None:
    def spoil(y: FloatArray) -> FloatArray:
        late = np.arange(N - 36, N, 3)
        spoilt = y.copy()
        spoilt[late] += 20.0 * NOISE * np.resize([1.0, -1.0], late.size)
        return spoilt

    names = list_names(explain_output(FAST, 1, spoil))
    assert "outliers" in names
    assert "unequal variance" not in names


def test_what_is_tried_of_a_start_is_what_is_advised() -> None:
    context = build_context([draw_record(FAST, 1)], "fopdt", FAST.values, initial="rest")
    skipped = [
        (one.change, re.search(r"skip: (\d+)", one.setting)) for one in history.propose(context)
    ]
    assert any(told for _, told in skipped)
    for change, told in skipped:
        assert change.get("skip") == (int(told[1]) if told else None)
