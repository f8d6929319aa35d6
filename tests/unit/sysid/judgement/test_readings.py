"""Holds chosen by the data: what the other reading would give, and whether it is as likely."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.findings import Finding
from sysid.data.records import Channel, Record
from sysid.judgement.input_hold import (
    HoldDoubt,
    find_hold_doubts,
    find_other_readings,
    list_input_holds,
    replace_holds,
    write_hold,
)
from sysid.judgement.levels import DEFECT_GAIN
from sysid.judgement.residual_context import Simulations
from sysid.models.catalogue.load import load_model
from sysid.results.parts import InputHold
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import Estimate
from tests.support.library.judged_records import (
    FAST,
    FINE,
    NOISE,
    STEP,
    N,
    draw_levels,
    draw_noise,
    draw_record,
    make_record,
)

LAG = Estimate("L", "s", 2.0, 0.0, 5.0, 0.01, (1.98, 2.02), "identified")
GAIN = Estimate("K", "1", 2.0, 0.0, 5.0, 0.01, (1.98, 2.02), "identified")
PROBLEM = Problem.build(load_model("fopdt"), [draw_record(FAST, 1)])
HELD = InputHold("u", "zero", "has two levels", "first", {"L": 2.3, "K": 2.005}, 0.1)
LINES = InputHold("u", "first", "varies smoothly", "zero", {"L": 1.7, "K": 2.005}, 0.1)


def find(hold: InputHold, doubt: str = "", gain: float = 0.0) -> list[Finding]:
    doubts = [HoldDoubt(doubt, gain)]
    return list(find_other_readings(PROBLEM, [hold], doubts, [GAIN, LAG], Simulations()))


def test_a_reading_in_doubt_that_leaves_an_interval_makes_that_estimate_dependent() -> None:
    (found,) = find(LINES, "Its samples do not follow each other")
    assert (found.severity, found.parameters, found.status) == ("caution", ("L",), "dependent")
    assert found.brief == "u may be read held"
    assert "L = 1.7 s instead of 2" in found.text
    assert "Its samples do not follow each other." in found.text
    assert found.moves[0].parameter == "L"
    assert found.moves[0].stderrs == pytest.approx(-30.0)
    assert found.advice == ""  # both fit as well


def find_true_reading(bend: float, most: int | None = None) -> Finding:
    """Find that the true reading fits better, of a record whose output has a bend beside it."""
    u = draw_levels(1)
    clean = FAST.respond(np.repeat(u, FINE))[::FINE]
    record = make_record(u, clean + bend * clean**2 + NOISE * draw_noise(1), reading="auto")
    problem = Problem.build(load_model("fopdt"), [record])
    values = {**FAST.values, "x(0)": FAST.gain * float(u[0])}
    truth = InputHold("u", "zero", "has two levels", "zero", values, 0.09)
    (found,) = find_other_readings(
        problem, [truth], [HoldDoubt("It fits", 20.0)], [LAG], Simulations(most)
    )
    return found


def test_a_reading_that_fits_clearly_better_is_the_advice_if_it_leaves_nothing_but_noise() -> None:
    found = find_true_reading(0.0)
    assert found.gain is not None
    assert found.gain > DEFECT_GAIN
    assert found.advice == "Use hold: {u: zero}."
    assert find_true_reading(0.2).advice == ""  # the output is curved beside
    assert find_true_reading(0.0, most=3).advice == ""  # nobody knows


def test_a_smaller_rms_is_no_doubt_if_coloured_noise_explains_it() -> None:
    """Another offset follows the slow noise, and gains 30 only if the noise were white."""
    record = draw_record(FAST, 3, pole=0.98)
    problem = Problem.build(load_model("fopdt"), [record])
    values = {**FAST.values, "x(0)": FAST.gain * float(record.inputs[0].values[0])}
    theta = np.array([values[name] for name in problem.free_names])
    simulated = problem.predict(theta[None])[0]
    offset = float(np.mean(problem.evaluator.measured - simulated))
    other = InputHold(
        "u", "zero", "has two levels", "zero", {**values, "y0": values["y0"] + offset}
    )
    rms = float(problem.evaluate_fitness(theta[None])[0])
    held = replace(other, rms_other=rms * float(np.exp(-15.0 / problem.n_scored)))
    (doubt,) = find_hold_doubts(problem, [held], theta, simulated, rms, Simulations())
    assert doubt.text == ""
    assert doubt.gain == pytest.approx(0.0, abs=1.0)
    (doubt,) = find_hold_doubts(problem, [held], theta, simulated, rms, Simulations(3))
    assert "fits better" in doubt.text  # not compared
    assert doubt.gain == pytest.approx(30.0)


def test_a_doubt_that_moves_nothing_is_a_note() -> None:
    (found,) = find(replace(LINES, estimates_other={"L": 2.001, "K": 2.0}), "It follows")
    assert (found.severity, found.parameters) == ("note", ())
    assert "the same estimates" in found.text


def test_a_reading_that_is_likelier_makes_what_it_moves_dependent_inside_its_interval_too() -> None:
    moved = replace(LINES, estimates_other={"L": 1.985, "K": 2.005})  # by 1.5 and 0.5 of its error
    assert [one.severity for one in find(moved, "It fits better")] == ["note"]
    (found,) = find(moved, "It fits better", gain=9.0)
    assert (found.severity, found.parameters) == ("caution", ("L",))


def test_what_held_samples_would_give_as_lines_is_a_note_if_it_moves_an_estimate() -> None:
    (found,) = find(HELD)
    assert (found.severity, found.parameters) == ("note", ())
    assert "Read as straight lines (hold: {u: first})" in found.text
    assert find(replace(HELD, estimates_other={"L": 2.001, "K": 2.0})) == []


def test_of_lines_without_a_doubt_and_of_a_given_hold_nothing_is_told() -> None:
    assert find(LINES) == []
    assert find(InputHold("u", "zero", None)) == []


def test_each_input_is_listed_with_the_reading_that_it_does_not_have() -> None:
    (hold,) = list_input_holds(PROBLEM)
    assert hold == InputHold("u", "zero", None)  # given
    record = make_record(draw_levels(1), draw_levels(1), reading="auto")
    problem = Problem.build(load_model("fopdt"), [record])
    (chosen,) = list_input_holds(problem)
    assert (chosen.chosen, chosen.other) == ("zero", "first")
    assert write_hold(chosen) == "hold: {u: first}"
    other = replace_holds(problem, [chosen])
    assert other.records[0].inputs[0].effective_hold == "first"
    assert problem.records[0].inputs[0].effective_hold == "zero"


def test_jumps_between_irregular_samples_are_uncertain_by_a_period() -> None:
    times = np.cumsum(np.random.default_rng(1).uniform(0.3, 0.7, N))
    u = draw_levels(1)
    record = Record((Channel("u", times, u),), (Channel("y", times, u),))
    problem = Problem.build(load_model("fopdt"), [record])
    notes = find_other_readings(
        problem, list_input_holds(problem), [HoldDoubt()], [GAIN, LAG], Simulations()
    )
    (found,) = (one for one in notes if one.explanation == "irregular sampling")
    period = float(found.text.rpartition(", ")[2].removesuffix(" s"))
    assert period == pytest.approx(STEP, rel=0.2)
