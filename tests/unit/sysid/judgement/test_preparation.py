"""Preparation and noise: what is known before an estimate, and what a noise model does."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.findings import Finding
from sysid.core.settings import Loss
from sysid.data.records import Record
from sysid.judgement.judge import Explained
from sysid.judgement.noise_findings import find_noise_model, find_unexplained
from sysid.judgement.preparation import (
    find_early_responses,
    find_unit_faults,
    find_useless_prediction,
)
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.residuals.residual_tests import ResidualTest, ResidualTestKind, ResidualTests
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import NoiseColour
from tests.support.library.judged_records import (
    FAST,
    NOISE,
    STEP,
    TIMES,
    N,
    build_context,
    draw_noise,
    draw_record,
    make_record,
)
from tests.support.library.small_models import LINE


def make_step(first: int, response: int) -> Record:
    """A step of the input, and an output that begins to move at a sample."""
    u = np.where(np.arange(N) >= first, 1.0, 0.0)
    late = np.maximum(np.arange(N) - response, 0.0) * STEP
    y = 1.0 - np.exp(-late / 8.0) + 0.002 * draw_noise(1)
    return make_record(u, y)


def test_an_output_that_moves_before_its_cause_is_a_caution() -> None:
    model = load_model("fopdt")
    (found,) = find_early_responses(Problem.build(model, [make_step(200, 100)]))
    assert found.severity == "caution"
    assert found.brief == "y moves before any input"
    assert "t = 50 s" in found.text or "t = 49" in found.text
    assert list(find_early_responses(Problem.build(model, [make_step(200, 210)]))) == []
    both = Problem.build(model, [make_step(200, 210), make_step(200, 100)])
    (second,) = find_early_responses(both)
    assert "in experiment 2" in second.text
    assert list(find_early_responses(Problem.build(parse_model(LINE), [make_step(200, 100)]))) == []


def test_units_that_do_not_fit_are_notes() -> None:
    record = draw_record(FAST, 1)
    assert find_unit_faults(Problem.build(load_model("fopdt"), [record])) == ()
    (u,), (y,) = record.inputs, record.outputs
    mixed = [Record((replace(u, unit="kPa"),), (replace(y, unit="Pa"),))]
    found = find_unit_faults(Problem.build(load_model("fopdt"), mixed))
    assert found
    assert {one.severity for one in found} == {"note"}


def test_a_prediction_of_a_model_that_reads_no_output_is_told_to_be_a_free_run() -> None:
    record = draw_record(FAST, 1)
    ahead = Problem.build(load_model("fopdt"), [record], prediction="one-step")
    (found,) = find_useless_prediction(ahead)
    assert found.severity == "note"
    assert "no output (y) is a state by itself" in found.text
    assert list(find_useless_prediction(Problem.build(load_model("fopdt"), [record]))) == []
    tube = Problem.build(
        load_model("tube"), [record], prediction="one-step", parameters={"L": {"upper": 5.0}}
    )
    assert list(find_useless_prediction(tube)) == []


def list_noise(noise_model: str, time: float, *, is_complete: bool = True) -> list[Finding]:
    problem = Problem.build(
        parse_model(LINE),
        [make_record(TIMES, TIMES)],
        loss=Loss(noise_model=noise_model),  # type: ignore[arg-type]
    )
    return list(
        find_noise_model(
            problem,
            {"y": time},
            np.array([2.0, 1.0]),
            is_complete=is_complete,
        )
    )


def test_a_noise_model_is_told_with_the_estimates_of_plain_squares() -> None:
    assert list_noise("white", 0.0) == []
    (found,) = list_noise("ar1", 3.0)
    assert found.severity == "note"
    assert "correlation time of y 3 s" in found.text
    assert "(loss: {noise_model: white}) gives a = 2, b = 1." in found.text


def test_a_noise_model_that_changes_nothing_or_is_not_complete_says_so() -> None:
    (white,) = list_noise("ar1", 0.0)
    assert "consistent with white noise" in white.text
    (cut,) = list_noise("ar1", 0.0, is_complete=False)
    assert "not estimated completely" in cut.text
    assert len(list_noise("ar1", 3.0, is_complete=False)) == 2


def list_unexplained(
    kind: ResidualTestKind,
    p: float,
    data: str = "estimation",
    *,
    is_done: bool = False,
    colour: NoiseColour = "white",
) -> list[Finding]:
    test = ResidualTest(
        0,
        "y",
        kind,
        "u" if kind == "independence" else None,
        "failed" if p < 0.05 else "passed",
        900,
        p=p,
    )
    analysis = CONTEXT.analysis
    assert analysis.uncertainty is not None
    coloured = replace(analysis, uncertainty=replace(analysis.uncertainty, noise_colour=colour))
    tests = ResidualTests(data, p >= 0.05, (test,))  # type: ignore[arg-type]
    return list(find_unexplained(tests, Explained((), is_done), coloured))


CONTEXT = build_context(
    [make_record(TIMES, 2.0 * TIMES + 1.0 + NOISE * draw_noise(1))],
    parse_model(LINE),
    {"a": 2.0, "b": 1.0},
)


def test_residuals_that_were_not_looked_at_are_a_caution_if_a_test_fails_clearly() -> None:
    (found,) = list_unexplained("whiteness", 1e-9)
    assert (found.severity, found.brief) == ("caution", "the residuals are not noise")
    (depends,) = list_unexplained("independence", 1e-9)
    assert depends.brief == "the residuals depend on u"
    assert list_unexplained("whiteness", 0.02) == []
    assert list_unexplained("independence", 0.3) == []


def test_what_was_looked_at_is_left_to_its_explanations() -> None:
    assert list_unexplained("whiteness", 1e-9, is_done=True) == []
    assert list_unexplained("independence", 1e-9, is_done=True) == []


def test_validation_data_that_depend_on_an_input_are_always_told() -> None:
    (found,) = list_unexplained("independence", 1e-9, "validation", is_done=True)
    assert found.severity == "caution"
    assert "validation data depend on u" in found.text


@pytest.mark.parametrize(
    ("colour", "words", "severity"),
    [("coloured", "errors allow for it", "note"), ("drifting", "too small", "caution")],
)
def test_colour_is_a_note_unless_errors_are_too_small(
    colour: NoiseColour, words: str, severity: str
) -> None:
    (found,) = list_unexplained("whiteness", 0.3, is_done=True, colour=colour)
    assert found.severity == severity
    assert words in found.text
