"""Conclusions: what is said of estimates and of the whole result follows from findings alone."""

from dataclasses import replace

import pytest

from sysid.core.findings import EstimateStatus, Finding, Move, note
from sysid.judgement.conclusions import (
    conclude_estimates,
    conclude_verdict,
    list_warnings,
    order_findings,
)
from sysid.results.verdict import Verdict
from sysid.uncertainty.estimates import Estimate

LAG = Estimate("L", "s", 0.52, 0.0, 5.0, 0.01, (0.50, 0.54), "identified")
GAIN = replace(LAG, name="K", unit="1", value=2.0)
ORDER = Finding(
    "order",
    "structure",
    "caution",
    "the data prefer sopdt",
    "the data prefer sopdt to fopdt.",
    "Use the model sopdt.",
    30.0,
    (Move("L", 0.4, 0.02, -12.0),),
    ("L",),
)
READING = Finding(
    "reading of an input",
    "reading",
    "caution",
    "u may be read held",
    "read held, u gives L = 0.57 s.",
    "Use hold: {u: zero}.",
    14.0,
    (Move("L", 0.57, None, 5.0),),
    ("L",),
)
CONSTANT = Finding(
    "constant",
    "structure",
    "serious",
    "the model does not explain the output",
    "a constant fits better.",
    status="refuted",
)


def conclude(
    *findings: Finding, estimates: tuple[Estimate, ...] = (GAIN, LAG)
) -> tuple[tuple[Estimate, ...], Verdict]:
    ordered = order_findings(findings)
    concluded = conclude_estimates(estimates, ordered)
    return concluded, conclude_verdict(concluded, ordered, ["K", "L"])


def test_two_findings_on_one_estimate_reach_verdict_estimate_and_warnings() -> None:
    for findings in ((ORDER, READING), (READING, ORDER)):
        (gain, lag), verdict = conclude(*findings)
        assert gain == GAIN
        assert lag.status == "dependent"
        told = "it is 0.400 ± 0.020 s if the data prefer sopdt; it is 0.57 s if u may be read held"
        assert lag.reason == told
        text = "trustworthy but for L: the data prefer sopdt, and u may be read held"
        assert verdict == Verdict("limited", text)
        warnings = list_warnings(order_findings(findings))
        assert warnings == (ORDER.sentences, READING.sentences)


def test_two_findings_on_two_estimates_name_both() -> None:
    other = replace(READING, parameters=("K",), moves=())
    (gain, lag), verdict = conclude(ORDER, other)
    assert (gain.status, gain.reason) == ("dependent", "u may be read held")
    assert lag.status == "dependent"
    assert verdict.trust == "not trustworthy"  # none of the parameters is identified
    assert "sopdt" in verdict.text
    assert "held" in verdict.text


def test_a_serious_finding_that_names_no_estimate_leaves_none_identified() -> None:
    fixed = replace(LAG, name="T", status="fixed")
    estimates, verdict = conclude(CONSTANT, estimates=(GAIN, LAG, fixed))
    assert [one.status for one in estimates] == ["refuted", "refuted", "fixed"]
    assert estimates[0].reason == "the model does not explain the output"
    assert verdict.text == "not trustworthy: the model does not explain the output"


def test_a_caution_that_names_no_estimate_leaves_all_as_they_are() -> None:
    early = Finding("response", "clocks", "caution", "y moves before any input", "y moves.")
    estimates, verdict = conclude(early)
    assert estimates == (GAIN, LAG)
    assert verdict == Verdict("limited", "trustworthy, but y moves before any input")


def test_a_note_moves_nothing_even_if_it_names_an_estimate() -> None:
    estimates, verdict = conclude(replace(ORDER, severity="note"), note("units", "record", "V, mV"))
    assert estimates == (GAIN, LAG)
    assert verdict == Verdict("trustworthy", "trustworthy")


def test_nothing_found_is_plainly_trustworthy() -> None:
    assert conclude() == ((GAIN, LAG), Verdict("trustworthy", "trustworthy"))


@pytest.mark.parametrize("status", ["at bound", "group", "unidentifiable", "fixed", "tied"])
def test_what_the_data_alone_say_of_an_estimate_stays(status: EstimateStatus) -> None:
    lag = replace(LAG, status=status, reason="as the data say")
    (_, told), _ = conclude(ORDER, estimates=(GAIN, lag))
    assert told == lag


def test_another_minimum_and_an_order_are_both_the_reason() -> None:
    lag = replace(LAG, status="ambiguous", reason="0.31 s fits as well")
    minimum = replace(ORDER, brief="another value of L fits as well", gain=None, moves=())
    minimum = replace(minimum, status="ambiguous")
    (_, told), verdict = conclude(minimum, ORDER, estimates=(GAIN, lag))
    assert told.status == "ambiguous"
    assert told.reason == "0.31 s fits as well; it is 0.400 ± 0.020 s if the data prefer sopdt"
    assert verdict.text.startswith(
        "trustworthy but for L: the data prefer sopdt, and another value"
    )


@pytest.mark.parametrize(
    ("milder", "harder"),
    [("dependent", "ambiguous"), ("ambiguous", "not settled"), ("not settled", "refuted")],
)
def test_the_hardest_status_counts(milder: EstimateStatus, harder: EstimateStatus) -> None:
    first, second = replace(ORDER, status=milder), replace(READING, status=harder)
    for findings in ((first, second), (second, first)):
        (_, lag), _ = conclude(*findings)
        assert lag.status == harder


def test_clear_explanations_come_first_then_what_is_severe_and_notes_last() -> None:
    unknown = replace(ORDER, gain=None, brief="no likelihood is compared")
    weak = replace(ORDER, gain=11.0, brief="hardly better")
    noise = replace(note("outliers", "sensor", "far outside"), gain=500.0)
    remark = note("units", "record", "V and mV")
    drift = replace(note("drift of a parameter", "constancy", "K drifts"), gain=20.0)
    expected = (ORDER, drift, READING, CONSTANT, weak, unknown, noise, remark)
    assert order_findings(expected[::-1]) == expected


def test_a_serious_finding_is_named_beside_the_likeliest_explanation() -> None:
    drift = replace(note("drift of a parameter", "constancy", "K drifts"), gain=200.0)
    _, verdict = conclude(READING, ORDER, CONSTANT, drift)
    assert verdict.text == (
        "not trustworthy: the data prefer sopdt, and the model does not explain the output"
    )


def test_a_note_that_explains_the_data_best_is_named_beside_the_doubt() -> None:
    drift = replace(note("drift of a parameter", "constancy", "K drifts"), gain=200.0)
    _, verdict = conclude(ORDER, drift)
    assert verdict.text == "trustworthy but for L: the data prefer sopdt, and drift of a parameter"


def test_initial_states_do_not_count_as_parameters_of_the_model() -> None:
    start = replace(LAG, name="x(0)")
    moved = replace(ORDER, parameters=("K", "L"))
    _, verdict = conclude(moved, estimates=(GAIN, LAG, start))
    assert verdict.text == "not trustworthy: the data prefer sopdt"


def test_what_is_said_twice_is_told_once() -> None:
    again = replace(CONSTANT, explanation="the same again")
    _, verdict = conclude(CONSTANT, again)
    assert verdict.text.count("the model does not explain the output") == 1
    assert list_warnings((CONSTANT, again)) == (CONSTANT.sentences,)


def test_a_value_out_of_bounds_is_no_reason() -> None:
    moved = replace(ORDER, moves=(Move("L", -1.0, 0.02, -90.0),))
    (_, lag), _ = conclude(moved)
    assert (lag.status, lag.reason) == ("dependent", "the data prefer sopdt")


@pytest.mark.parametrize(("gain", "first"), [(200.0, CONSTANT), (300.0, None)])
def test_why_a_model_fails_takes_half_of_what_it_leaves(gain: float, first: Finding | None) -> None:
    """Half of the variance of 400 samples is a gain of 400 ln 2 = 277."""
    step = replace(ORDER, explanation="step of a sensor", gain=gain)
    assert order_findings([step, CONSTANT], 400)[0] == (first or step)
    assert order_findings([step, ORDER], 400)[0] == step  # no model fails


def test_that_a_model_fails_is_named_once_and_then_why() -> None:
    little = replace(CONSTANT, explanation="little fit", brief="the model explains little")
    _, verdict = conclude(CONSTANT, little, replace(ORDER, gain=None))
    assert verdict.text == (
        "not trustworthy: the model does not explain the output, and the data prefer sopdt"
    )


def test_what_the_data_do_not_tell_comes_after_what_may_be_why() -> None:
    lack = replace(ORDER, explanation="no information", gain=None)
    drift = replace(ORDER, explanation="coloured noise", gain=None)
    assert order_findings([lack, drift]) == (drift, lack)
