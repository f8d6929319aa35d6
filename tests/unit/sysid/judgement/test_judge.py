"""The judge: the likeliest explanations, one beside the other, on one scale."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.findings import Finding, note
from sysid.core.settings import Loss
from sysid.data.records import Channel, Record
from sysid.judgement import judge
from sysid.judgement.conclusions import order_findings
from sysid.judgement.judge import (
    Explained,
    explain_residuals,
    leaves_noise,
    select_explanations,
)
from sysid.judgement.levels import DEFECT_GAIN, STRONG_ODDS
from sysid.judgement.residual_context import Candidate, ResidualContext, Simulations
from sysid.models.parse import parse_model
from sysid.uncertainty.analysis import analyse_estimate
from tests.support.library.defects import CONSTANCY, LATE, SENSOR
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
    explain,
    hold,
    list_names,
    make_record,
)
from tests.support.library.small_models import LINE


def make_finding(explanation: str, gain: float | None, *names: str) -> Finding:
    severity = "caution" if names else "note"
    return Finding(
        explanation,
        "structure",
        severity,
        explanation,
        f"{explanation}.",
        gain=gain,
        parameters=names,
    )


def explain_line(*parts: np.ndarray) -> Explained:
    """Explain what a line leaves of a record with defects (n,)."""
    u = draw_levels(1)
    y = 2.0 * u + 1.0 + NOISE * draw_noise(1) + np.sum(parts, axis=0)
    return explain_residuals(
        build_context([make_record(u, y)], parse_model(LINE), {"a": 2.0, "b": 1.0})
    )


@pytest.mark.parametrize(
    ("bend", "jump"),
    [
        (0.2, 0.1),
        (0.2, 0.4),
        (0.5, 0.4),
        (0.5, 0.1),
    ],
)
def test_two_defects_are_both_found(bend: float, jump: float) -> None:
    curve, late = bend * (draw_levels(1) - 1.0) ** 2, jump * LATE
    found = explain_line(curve, late)
    briefs = " ".join(one.brief for one in found.findings)
    assert "y is curved" in briefs
    assert "at about 11" in briefs or "from about 11" in briefs
    alone = explain_line(curve).findings
    assert "about" not in " ".join(one.brief for one in alone)


def test_one_defect_is_one_finding_and_its_rivals_are_in_its_text() -> None:
    """An offset of the line, of the sensor, and a load are the same to a line."""
    (found,) = explain_line(0.3 * LATE).findings
    assert found.explanation in ("change of a parameter", "step of a sensor", "load")
    assert "As likely: " in found.text
    assert found.text.count("about 115 s") >= 3


def test_what_explains_is_worth_a_defect_and_no_sound_record_has_it() -> None:
    for seed in range(5):
        u = draw_levels(seed)
        y = 2.0 * u + 1.0 + NOISE * draw_noise(seed, 0.8)
        context = build_context([make_record(u, y)], parse_model(LINE), {"a": 2.0, "b": 1.0})
        assert explain_residuals(context).findings == ()
    for one in explain_line(0.3 * LATE).findings:
        assert one.gain is not None
        assert one.gain > DEFECT_GAIN


def test_more_of_a_defect_gains_more() -> None:
    gains = [explain_line(size * LATE).findings[0].gain or 0.0 for size in (0.05, 0.1, 0.3)]
    assert gains == sorted(gains)


def test_simulations_are_counted_and_few() -> None:
    context = build_context([draw_record(FAST, 1)], "fopdt", FAST.values)
    explain_residuals(context)
    assert 10 < context.simulations.spent < 200


@pytest.mark.parametrize("most", [0, 1, 5, 20])
def test_no_more_simulations_are_taken_than_are_allowed(most: int) -> None:
    whole = build_context([draw_record(FAST, 1, pole=0.8)], "fopdt", FAST.values)
    limited = replace(whole, simulations=Simulations(most))
    explained = explain_residuals(limited)
    assert limited.simulations.spent <= most
    assert not explained.is_done
    assert not explained.is_noise
    assert explain_residuals(whole).is_done


@pytest.mark.parametrize("size", [1e200, np.inf, np.nan])
def test_a_run_that_diverges_explains_nothing(size: float, monkeypatch: pytest.MonkeyPatch) -> None:
    def propose_diverged(context: ResidualContext) -> Iterator[Candidate]:
        columns = size * context.weigh(draw_levels(1))
        yield Candidate("curve of an actuator", "actuator", columns, "a curve", "a curve")

    expected = explain_line(LATE)
    monkeypatch.setattr(judge, "_CHEAP_PROPOSERS", (*judge._CHEAP_PROPOSERS, propose_diverged))
    assert explain_line(LATE) == expected


def test_nothing_is_simulated_after_the_time_limit() -> None:
    whole = build_context([draw_record(FAST, 1, pole=0.8)], "fopdt", FAST.values)
    late = replace(whole, simulations=Simulations(is_late=lambda: True))
    assert not explain_residuals(late).is_done
    assert late.simulations.spent == 0


def test_a_repeated_judgement_is_the_same() -> None:
    record = CONSTANCY[1].draw(FAST, 1)
    assert explain(FAST, record) == explain(FAST, record)


@pytest.mark.parametrize("gain", [1e-3, 1e6])
def test_units_do_not_matter(gain: float) -> None:
    """The same record in another unit of its output has the same explanations."""
    record = SENSOR[1].draw(FAST, 1)
    (y,) = record.outputs
    scaled = replace(record, outputs=(replace(y, values=gain * y.values),))
    values = FAST.values
    other = {**values, "K": gain * values["K"], "y0": gain * values["y0"]}
    first = explain_residuals(build_context([record], "fopdt", values)).findings
    second = explain_residuals(build_context([scaled], "fopdt", other)).findings
    assert [one.explanation for one in first] == [one.explanation for one in second]
    assert [one.parameters for one in first] == [one.parameters for one in second]
    gains = [one.gain or 0.0 for one in first]
    assert [one.gain for one in second] == pytest.approx(gains, rel=0.02, abs=1.0)


@pytest.mark.parametrize("samples", [12, 25, 60])
def test_short_records_are_judged_or_left_alone(samples: int) -> None:
    u = draw_levels(1, samples)
    y = 2.0 * u + NOISE * draw_noise(1, n=samples)
    context = build_context([make_record(u, y)], parse_model(LINE), {"a": 2.0})
    explained = explain_residuals(context)
    assert (explained.findings, explained.is_done) == ((), samples > 14)


def test_residuals_of_nothing_are_not_judged() -> None:
    u = draw_levels(1)
    exact = build_context([make_record(u, 2.0 * u + 1.0)], parse_model(LINE), {"a": 2.0, "b": 1.0})
    found = explain_residuals(exact)
    assert all(one.severity == "note" for one in found.findings)


def test_only_squares_are_judged() -> None:
    record = CONSTANCY[1].draw(FAST, 1)
    robust = build_context([record], "fopdt", FAST.values, loss=Loss("soft-l1", 0.1))
    assert explain_residuals(robust) == Explained()
    context = build_context([record], "fopdt", FAST.values)
    bare = analyse_estimate(context.problem, context.theta, 0)
    assert bare.residuals_and_sensitivities is None
    assert explain_residuals(ResidualContext(context.problem, context.theta, bare)) == Explained()


def test_noise_is_what_moves_no_estimate() -> None:
    moved, still = make_finding("order", 30.0, "L"), make_finding("outliers", 90.0)
    assert Explained((), True).is_noise
    assert Explained((still,), True).is_noise
    assert not Explained((still, moved), True).is_noise


def test_of_two_scales_the_likelier_explanations_are_kept() -> None:
    curve, second = make_finding("curve", 40.0, "K"), make_finding("drift", 20.0, "T")
    order = make_finding("order", 41.0, "L")
    assert select_explanations((curve, second), (order,)) == (curve, second, order)
    likelier = replace(order, gain=40.0 + STRONG_ODDS + 1.0)
    assert select_explanations((curve, second), (likelier,)) == (likelier,)
    less = replace(order, gain=40.0 - STRONG_ODDS - 1.0)
    assert select_explanations((curve, second), (less,)) == (curve, second)


def test_what_is_compared_with_nothing_is_kept_always() -> None:
    remark = note("irregular sampling", "reading", "u is sampled irregularly")
    curve = make_finding("curve", 40.0, "K")
    assert select_explanations((curve,), (remark,)) == (curve, remark)
    assert select_explanations((), ()) == ()
    assert select_explanations((), (remark,)) == (remark,)
    order = make_finding("order", 8.0, "L")
    assert select_explanations((), (order,)) == (order,)


@pytest.mark.parametrize("explanation", ["outliers", "unequal variance"])
@pytest.mark.parametrize("gain", [20.0, 300.0])
def test_what_explains_the_noise_hides_no_other_explanation(explanation: str, gain: float) -> None:
    of_noise, order = make_finding(explanation, gain), make_finding("order", 50.0, "L")
    assert select_explanations((of_noise,), (order,)) == (of_noise, order)
    drift = make_finding("drift", 20.0, "T")
    assert select_explanations((drift, of_noise), (order,)) == (of_noise, order)
    start = make_finding("start", -3.0, "L")
    assert select_explanations((of_noise,), (start,)) == (of_noise, start)


def test_a_load_acts_in_its_own_experiment_only() -> None:
    u, load = draw_levels(1), 0.5 * LATE
    y = FAST.respond(hold(u + load))[::FINE] + NOISE * draw_noise(1)
    records = [draw_record(FAST, seed) for seed in (2, 3)]
    records.insert(1, make_record(u, y))
    (load_found, *_) = explain(FAST, *records).findings
    assert load_found.explanation == "load"
    assert "of experiment 2" in load_found.brief
    gain = {move.parameter: move.value for move in load_found.moves}["K"]
    assert gain == pytest.approx(FAST.gain, rel=0.01)


@pytest.mark.parametrize("seed", [1, 3])
def test_what_goes_against_its_words_explains_nothing(seed: int) -> None:
    """Of a noisy input of two levels, less than its dead zone is what acts: the levels."""
    levels = np.where(draw_levels(seed) > 1.0, 2.0, 0.0)
    y = FAST.respond(hold(levels))[::FINE] + NOISE * draw_noise(seed)
    record = make_record(levels + 0.2 * draw_noise(seed + 1), y, reading="first")
    (first, *_) = explain(FAST, record).findings
    assert first.explanation == "noise of an input"
    assert "dead zone" not in first.text


def test_two_experiments_in_one_record_have_the_same_parameters() -> None:
    parts = [draw_levels(seed, N // 2) for seed in (1, 2)]
    y = np.concatenate([FAST.respond(hold(u))[::FINE] for u in parts]) + NOISE * draw_noise(1)
    (first, *_) = explain(FAST, make_record(np.concatenate(parts), y)).findings
    assert first.explanation == "another experiment"
    assert "begins at about 100" in first.brief
    for move in first.moves:
        assert move.value == pytest.approx(FAST.values[move.parameter], rel=0.02)


def test_after_a_gap_another_experiment_begins() -> None:
    """The input moved in the gap, so no sample after it says where the plant was."""
    u = np.where((TIMES > 100.0) & (TIMES < 130.0), 2.0, draw_levels(1))
    y = FAST.respond(hold(u))[::FINE] + NOISE * draw_noise(1)
    kept = (TIMES < 60.0) | (TIMES > 130.0)
    record = make_record(u[kept], y[kept], times=TIMES[kept])
    (first, *_) = explain(FAST, record).findings
    assert first.explanation == "another experiment"
    assert "at about 130.5 s, after a gap" in first.text
    for move in first.moves:
        assert move.value == pytest.approx(FAST.values[move.parameter], rel=0.02)


def test_a_short_record_with_many_inputs_has_no_dynamics_in_its_noise() -> None:
    names, n = [f"u{i}" for i in range(5)], 52
    model = parse_model(
        {
            "name": "sum",
            "form": "differential",
            "inputs": dict.fromkeys(names, "1"),
            "states": {"x": "1"},
            "parameters": {f"a{i}": {"lower": -10, "upper": 10, "unit": "1"} for i in range(5)},
            "equations": {"x": "-x"},
            "outputs": {"y": "x + " + " + ".join(f"a{i}*u{i}" for i in range(5))},
            "initial": {"x": 0},
            "solver": {"method": "rk4", "step": "sample", "substeps": 1},
        }
    )
    found = list[str]()
    for seed in range(12):
        random = np.random.default_rng(seed)
        times, inputs = STEP * np.arange(n), random.standard_normal((5, n))
        y = np.sum(inputs, axis=0) + NOISE * random.standard_normal(n)
        channels = [Channel(name, times, u) for name, u in zip(names, inputs, strict=True)]
        context = build_context(
            [Record(channels, [Channel("y", times, y)])],
            model,
            dict.fromkeys((f"a{i}" for i in range(5)), 1.0),
        )
        found += list_names(explain_residuals(context))
    assert "missing dynamics" not in found
    assert "missing nonlinearity" not in found


def test_outliers_hide_no_change_and_no_change_hides_them() -> None:
    u = draw_levels(1)
    y = FAST.respond(hold(u))[::FINE] + 0.3 * LATE + NOISE * draw_noise(1)
    y[np.random.default_rng(5).choice(N, 8, replace=False)] += 2.0
    names = list_names(explain(FAST, make_record(u, y)))
    assert names[0] in ("change of a parameter", "step of a sensor")
    assert "outliers" in names


def test_what_was_found_first_is_the_reason() -> None:
    u = draw_levels(1)
    share = TIMES / TIMES[-1]
    late = replace(FAST, delay=FAST.delay + 0.8)
    first, second = (one.respond(hold(u))[::FINE] for one in (FAST, late))
    y = (1.0 - share) * first + share * second + NOISE * draw_noise(1)
    found = explain(FAST, make_record(u, y)).findings
    assert found[0].explanation in ("drift of a clock", "drift of a time lag")
    assert order_findings(found)[0] == found[0]


def propose_step(
    explanation: str, size: float, **fields: Any
) -> Callable[[ResidualContext], Iterator[Candidate]]:
    """Propose that the output jumps by so much, in words that are not those of a sensor."""

    def propose(context: ResidualContext) -> Iterator[Candidate]:
        columns = context.weigh(size * LATE)
        yield Candidate(explanation, "structure", columns, "it jumps", "it jumps", **fields)

    return propose


def propose_ramp(context: ResidualContext) -> Iterator[Candidate]:
    columns = context.weigh(TIMES)
    yield Candidate("a ramp", "structure", columns, "it jumps", "it jumps in another way")


def use_proposers(
    monkeypatch: pytest.MonkeyPatch, *proposers: Callable[[ResidualContext], Iterator[Candidate]]
) -> None:
    monkeypatch.setattr(judge, "_CHEAP_PROPOSERS", proposers)
    monkeypatch.setattr(judge, "_FREE_PROPOSERS", ())
    monkeypatch.setattr(judge, "_COSTLY_PROPOSERS", ())


def test_what_is_taken_twice_is_told_once(monkeypatch: pytest.MonkeyPatch) -> None:
    use_proposers(monkeypatch, propose_step("a step", 1.0), propose_ramp)
    found = explain_line(0.5 * LATE, 0.004 * TIMES).findings
    assert [one.brief for one in found if not one.is_of_noise] == ["it jumps"]


@pytest.mark.parametrize("has_rival", [False, True])
def test_a_setting_is_advised_only_if_nothing_is_as_likely(
    has_rival: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    u = draw_levels(1)
    y = 2.0 * u + 1.0 + NOISE * draw_noise(1)
    sound, jumping = make_record(u, y), make_record(u, y + 0.3 * LATE)
    rival = [propose_step("a rival", 2.0)] if has_rival else []
    fields = {"setting": "Use it.", "change": {"records": [sound]}, "doubtful": ("b",)}
    use_proposers(monkeypatch, propose_step("a step", 1.0, **fields), *rival)
    (found,) = explain_residuals(
        build_context([jumping], parse_model(LINE), {"a": 2.0, "b": 1.0})
    ).findings
    assert ("Use it." in found.advice) is not has_rival
    assert ("As likely" in found.text) is has_rival


@pytest.mark.parametrize("excess", [-0.002, -0.01, 0.5])
def test_a_fit_that_ends_at_a_bound_is_no_cure(excess: float) -> None:
    context = build_context([draw_record(FAST, 1)], "fopdt", FAST.values)
    lag = float(context.theta[context.problem.free_names.index("L")])
    bounded = context.problem.rebuild(parameters={"L": {"upper": lag + excess}})
    start = np.clip(context.theta, bounded.evaluator.lower, bounded.evaluator.upper)
    assert leaves_noise(bounded, start, Simulations()) is (excess > 0.0)


@pytest.mark.parametrize("seed", [13, 14])
def test_a_likely_explanation_without_a_gain_opens_the_costly_ones(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def propose_costly(context: ResidualContext) -> Iterator[Candidate]:
        calls.append(context)
        return iter(())

    monkeypatch.setattr(judge, "_COSTLY_PROPOSERS", (propose_costly,))
    context = build_context([draw_record(FAST, seed)], "fopdt", FAST.values)
    assert explain_residuals(context).findings == ()
    assert calls == [context]


def test_samples_of_repeats_are_no_series() -> None:
    u = draw_levels(1)
    y = 2.0 * u + 1.0 + NOISE * draw_noise(1) + 0.3 * LATE
    for repeats in (None, np.repeat(np.arange(4.0), N // 4)):
        output = Channel("y", TIMES, y, repeats=repeats)
        record = Record((Channel("u", TIMES, u, hold="zero"),), (output,))
        explained = explain_residuals(
            build_context([record], parse_model(LINE), {"a": 2.0, "b": 1.0})
        )
        assert explained.is_done is bool(explained.findings) is (repeats is None)


@pytest.mark.parametrize(("size", "is_cure"), [(0.0, True), (0.008, False)])
def test_a_cure_leaves_nothing_that_may_be_a_defect(
    size: float, is_cure: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Something with strong odds is left, but not with those of a defect."""

    def propose_wave(context: ResidualContext) -> Iterator[Candidate]:
        columns = context.weigh(np.sin(TIMES))
        yield Candidate("a wave", "structure", columns, "it waves", "it waves")

    use_proposers(monkeypatch, propose_wave)
    u = draw_levels(1)
    y = 2.0 * u + 1.0 + NOISE * draw_noise(1) + size * np.sin(TIMES)
    context = build_context([make_record(u, y)], parse_model(LINE), {"a": 2.0, "b": 1.0})
    explained = explain_residuals(context)
    assert explained.is_done
    assert explained.is_doubtful is not is_cure
    assert explained.findings == ()
    assert leaves_noise(context.problem, context.theta, Simulations()) is is_cure


def test_another_order_takes_the_place_of_its_columns() -> None:
    columns = [make_finding(name, 30.0, "L") for name in ("one more time constant", "outliers")]
    order = make_finding("order", 28.0, "L")
    assert select_explanations(columns, [order]) == (columns[1], order)
    weak = make_finding("order", 11.0, "L")
    assert select_explanations(columns, [weak]) == tuple(columns)
