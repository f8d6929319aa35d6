"""Whether estimates hang on input from before the record that nobody recorded."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.findings import Finding
from sysid.core.settings import GeneticAlgorithm
from sysid.data.derivations import derive_recording
from sysid.data.records import Channel, Recording
from sysid.identification.identify import identify
from sysid.judgement.judge import explain_residuals
from sysid.judgement.residual_context import ResidualContext
from sysid.judgement.unrecorded_input import find_assumed_samples, find_unrecorded_input
from sysid.models.catalogue.load import load_model
from sysid.models.model import FixedInitial, Model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from sysid.uncertainty.analysis import Analysis, analyse_estimate

H, CUT = 0.1, 120
TRUE = {"K": 2.0, "T": 0.6, "L": 0.73, "y0": 0.5}
FOPDT = load_model("fopdt")
BOUNDS: dict[str, dict[str, Any]] = {"L": {"upper": 1.5}, "T": {"upper": 5}}


def make_recording(seed: int, *, was_at_rest: bool, samples: int = 300) -> Recording:
    """A random binary test of a first-order lag with dead time; the cut is at sample 120."""
    rng = np.random.default_rng(seed)
    count = CUT + samples
    times = H * np.arange(count)
    command = np.repeat(rng.choice([-1.0, 1.0], count // 5 + 1), 5)[:count]
    if was_at_rest:
        command[CUT - 12 : CUT] = command[CUT]
    else:  # it jumps four samples before the cut
        command[CUT - 12 : CUT - 4], command[CUT - 4 : CUT + 1] = -command[CUT], command[CUT]
        command[CUT - 4 : CUT - 2] = -command[CUT]
    channel = Channel("u", times, command, "1", "zero")
    [y] = simulate(FOPDT, [channel], {**TRUE, "x(0)": 0.0}, times=times).channels
    noisy = replace(y, values=y.values + 0.05 * rng.normal(size=count))
    return Recording((channel, noisy))


def build_problem(
    recording: Recording, *, history: bool, model: Model = FOPDT, skip: int = 0
) -> Problem:
    part = derive_recording(recording, [{"trim": {"rows": [CUT, CUT + 300], "history": history}}])
    record = part.to_record({"u": "u"}, {"y": "y"})
    return Problem.build(model, [record], parameters=BOUNDS, skip=skip)


def analyse_problem(problem: Problem) -> Analysis:
    start = np.array([TRUE.get(one.name, 0.0) for one in problem.free_parameters])
    [found] = refine_candidates(problem, [start])
    assert found is not None
    return analyse_estimate(problem, found.theta)


def explain(problem: Problem) -> list[Finding]:
    analysis = analyse_problem(problem)
    theta = np.array([one.value for one in analysis.estimates if one.is_free])
    found = explain_residuals(ResidualContext(problem, theta, analysis)).findings
    return [one for one in found if one.explanation == "input before the record"]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_record_that_begins_in_the_middle_of_a_test_is_told_of(seed: int) -> None:
    recording = make_recording(seed, was_at_rest=False)
    [found] = explain(build_problem(recording, history=False))
    assert found.brief == "u moved before the record"
    assert found.family == "history"
    assert found.severity == "caution"
    assert "skip" in found.advice
    assert explain(build_problem(recording, history=True)) == []
    assert explain(build_problem(recording, history=False, skip=8)) == []


def test_its_moves_are_those_of_estimation_without_these_samples() -> None:
    recording = make_recording(1, was_at_rest=False)
    [found] = explain(build_problem(recording, history=False))
    without = {
        one.name: one
        for one in analyse_problem(build_problem(recording, history=False, skip=8)).estimates
    }
    for move in found.moves:
        if move.parameter in found.parameters:
            other = without[move.parameter]
            assert abs(move.value - other.value) < 2 * (other.stderr or 0.0)


def test_of_a_record_that_begins_at_rest_nothing_is_told() -> None:
    """The guess is right, so the first samples fit the others: 20 draws, none told of."""
    for seed in range(20):
        assert explain(build_problem(make_recording(seed, was_at_rest=True), history=False)) == []


def test_a_contradiction_is_a_note_that_says_what_to_skip() -> None:
    problem = build_problem(make_recording(0, was_at_rest=False), history=False)
    analysis = analyse_problem(problem)
    assert list(find_unrecorded_input(problem, analysis, [], is_contradicted=False)) == []
    [found] = find_unrecorded_input(problem, analysis, [], is_contradicted=True)
    assert (found.severity, found.parameters) == ("note", ())
    assert found.advice.endswith("skip: 8.")
    assert list(find_unrecorded_input(problem, analysis, [found], is_contradicted=True)) == []


def test_samples_that_read_an_assumed_input_end_with_the_estimated_lag() -> None:
    recording = make_recording(0, was_at_rest=True)
    problem = build_problem(recording, history=False)
    [part] = find_assumed_samples(problem, analyse_problem(problem))
    assert np.flatnonzero(part).tolist() == list(range(8))  # 0.7 s lies before L = 0.73 s
    short = derive_recording(
        recording, [{"trim": {"rows": [CUT - 4, CUT + 300], "history": False}}]
    )
    record = derive_recording(short, [{"trim": {"rows": [4, 304]}}]).to_record(
        {"u": "u"}, {"y": "y"}
    )
    known = Problem.build(FOPDT, [record], parameters=BOUNDS)
    [part] = find_assumed_samples(known, analyse_problem(known))
    assert np.count_nonzero(part) == 4


def test_a_given_start_does_not_hide_an_input_that_was_assumed_wrongly() -> None:
    recording = make_recording(2, was_at_rest=False)
    start = float(recording.channel("y").values[CUT]) - TRUE["y0"]
    model = replace(FOPDT, initial=(FixedInitial(start),))
    assert len(explain(build_problem(recording, history=False, model=model))) == 1


def test_a_result_warns() -> None:
    part = derive_recording(
        make_recording(0, was_at_rest=False), [{"trim": {"rows": [CUT, 420], "history": False}}]
    )
    record = part.to_record({"u": "u"}, {"y": "y"})
    found = identify(FOPDT, record, GeneticAlgorithm(generations=80), parameters=BOUNDS)
    assert any("not at its first value before the record" in one for one in found.warnings)
    assert "u moved before the record" in found.verdict.text
