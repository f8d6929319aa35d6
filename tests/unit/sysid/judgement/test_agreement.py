"""Agreement with the data: whether the model explains them at all."""

import math
from typing import Any

import numpy as np
import pytest

from sysid.core.findings import Finding, Severity
from sysid.data.records import Channel, Record
from sysid.judgement.agreement import (
    find_better_yardstick,
    find_constant_outputs,
    find_disagreement,
    find_exchanged_channels,
)
from sysid.judgement.yardstick import Yardstick
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.simulation.fit_metrics import ChannelMetrics, Metrics
from sysid.simulation.problem import Problem
from tests.support.library.judged_records import (
    FAST,
    FINE,
    NOISE,
    N,
    draw_levels,
    draw_noise,
    hold,
    make_record,
)
from tests.support.library.small_models import LINE


def make_channel(rms: float, line_rms: float, experiment: int = 0, **fields: Any) -> ChannelMetrics:
    values = {"fit_percent": 95.0, "output": "y", **fields}
    return ChannelMetrics(experiment, unit="V", samples=100, rms=rms, line_rms=line_rms, **values)


def find(
    fit: float = 95.0,
    *channels: ChannelMetrics,
    limit: float | None = None,
    are_noise: bool = False,
) -> list[Finding]:
    metrics = Metrics(0.1, "V", fit, channels)
    return list(find_disagreement(metrics, limit, are_residuals_noise=are_noise))


def test_a_model_that_fits_is_no_finding() -> None:
    assert find() == []
    assert find(95.0, make_channel(0.1, 2.0)) == []
    assert find(limit=0.2) == []


def test_a_small_fit_beside_noise_is_no_failure_and_else_it_is() -> None:
    assert find(15.0, are_noise=True) == []
    (found,) = find(15.0)
    assert (found.severity, found.status) == ("serious", "refuted")
    assert found.brief == "the model explains little of the output"
    assert find(31.0) == []


@pytest.mark.parametrize(("fit", "words"), [(-3.0, "fits better"), (0.0, "fits as well")])
def test_a_constant_that_fits_as_well_refutes_the_model(fit: float, words: str) -> None:
    for are_noise in (True, False):
        (found,) = find(fit, are_noise=are_noise)
        assert found.severity == "serious"
        assert found.brief == "the model does not explain the output"
        assert words in found.text
        assert found.parameters == ()  # so it concerns all


def test_an_undefined_fit_is_no_failure_of_the_model() -> None:
    assert find(math.nan) == []


def test_an_error_above_the_safe_limit_makes_the_model_invalid() -> None:
    (found,) = find(limit=0.05)
    assert (found.brief, found.severity) == ("the model is invalid", "serious")
    assert "0.1" in found.text
    assert "0.05" in found.text


def test_a_straight_line_that_explains_the_whole_better_is_serious() -> None:
    (found,) = find(95.0, make_channel(0.3, 0.2))
    assert (found.severity, found.brief) == ("serious", "a straight line explains y better")
    assert "RMS 0.3 against 0.2 V" in found.text


def test_a_straight_line_through_a_part_is_a_caution_with_its_experiment() -> None:
    (found,) = find(
        95.0, make_channel(0.1, 2.0), make_channel(0.1, 2.0, 2), make_channel(0.3, 0.1, 1)
    )
    assert found.severity == "caution"
    assert found.brief == "a straight line explains a part of y better"
    assert "y of experiment 2" in found.text


def test_a_straight_line_through_the_noise_of_an_experiment_at_rest_is_a_note() -> None:
    (found,) = find(95.0, make_channel(0.1, 2.0), make_channel(0.11, 0.1, 1))
    assert found.severity == "note"
    assert "y of experiment 2" in found.text


def test_errors_of_the_solver_and_too_few_samples_for_a_line_are_no_finding() -> None:
    exact = make_channel(0.11, 0.1, 1, fit_percent=99.9999)
    assert find(95.0, make_channel(0.1, 2.0, fit_percent=99.9999), exact) == []
    assert find(95.0, make_channel(0.1, math.nan), make_channel(0.1, 2.0, 1)) == []


def test_of_two_outputs_the_one_that_a_line_explains_is_named() -> None:
    found = find(95.0, make_channel(0.1, 2.0), make_channel(0.3, 0.2, output="z"))
    assert [one.brief for one in found] == ["a straight line explains z better"]


@pytest.mark.parametrize("level", [0.0, 0.3, -7.0])
def test_a_constant_output_is_serious_if_there_is_no_other(level: float) -> None:
    record = make_record(np.arange(float(N)), np.full(N, level))
    problem = Problem.build(parse_model(LINE), [record])
    (found,) = find_constant_outputs(problem)
    assert (found.severity, found.brief) == ("serious", "the output is constant")
    assert f"({level:.4g})" in found.text
    assert str(N) in found.text


def test_an_output_that_moves_in_one_of_two_records_is_not_constant() -> None:
    still = make_record(np.arange(float(N)), np.full(N, 1.0))
    moving = make_record(np.arange(float(N)), np.where(np.arange(N) == 7, 1.1, 1.0))
    assert list(find_constant_outputs(Problem.build(parse_model(LINE), [still, moving]))) == []


def test_one_constant_output_of_two_is_a_caution() -> None:
    model = parse_model(LINE | {"outputs": {"y": "a*u(t) + b + x", "z": "b + x"}})
    record = make_record(np.arange(float(N)), np.arange(float(N)))
    (y,) = record.outputs
    both = Record(record.inputs, (y, Channel("z", y.times, np.full(N, 2.0))))
    (found,) = find_constant_outputs(Problem.build(model, [both], weights={"y": 1.0, "z": 1.0}))
    assert (found.severity, found.brief) == ("caution", "z is constant")


def explain_yardstick(*explanations: Finding, gain: float = 54.4) -> Finding:
    """Compare a model of 81 % with a linear one of 93 %, beside explanations of its residuals."""
    yardstick = Yardstick("y", 4, 300, 93.2, 81.3, 0.07, 0.2, gain)
    (found,) = find_better_yardstick(yardstick, ["K", "L"], explanations)
    return found


@pytest.mark.parametrize(
    ("name", "severity", "gain", "expected"),
    [
        ("unequal variance", "note", 200.0, "caution"),  # of the noise: no reason for a misfit
        ("jump of the states", "note", 22.3, "caution"),  # explains less than the linear model
        ("start", "note", 195.0, "note"),
        ("order", "caution", 15.0, "note"),
        ("order", "caution", 1.0, "caution"),  # as likely as the model, and no better
    ],
)
def test_a_better_linear_model_is_a_doubt_unless_something_tells_why(
    name: str, severity: Severity, gain: float, expected: str
) -> None:
    explanation = Finding(name, "structure", severity, name, f"{name}.", gain=gain)
    found = explain_yardstick(explanation)
    assert (found.severity, bool(found.parameters)) == (expected, expected == "caution")
    assert explain_yardstick().severity == "caution"


@pytest.mark.parametrize("is_exchanged", [False, True])
def test_exchanged_channels_are_found_where_the_effect_tells_less_of_its_cause(
    is_exchanged: bool,
) -> None:
    """A filtered signal explains what it is made of less well than the other way round."""
    u = draw_levels(1)
    y = FAST.respond(hold(u))[::FINE] + 2.0 * NOISE * draw_noise(1)
    record = make_record(y, u) if is_exchanged else make_record(u, y)
    problem = Problem.build(load_model("fopdt"), [record])
    model = np.full(N, float(np.mean(record.outputs[0].values)))
    metrics = Metrics(1.0, "V", 0.0, ())
    found = list(find_exchanged_channels(problem, model, metrics))
    assert [one.explanation for one in found] == ["exchanged channels"] * is_exchanged
