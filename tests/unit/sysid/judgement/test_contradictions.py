"""Validation data that contradict the model, or say nothing of it: they score and never choose."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.findings import Finding
from sysid.core.types import FloatArray
from sysid.data.records import Record
from sysid.judgement.validation import Validation, find_contradictions, validate_estimates
from sysid.models.parse import parse_model
from sysid.simulation.fit_metrics import Metrics
from sysid.simulation.problem import Problem, compute_metrics
from tests.support.library.judged_records import (
    NOISE,
    build_context,
    draw_levels,
    draw_noise,
    make_record,
)
from tests.support.library.small_models import LINE

MODEL = parse_model(LINE)


def make_line(
    seed: int, a: float = 2.0, u: FloatArray | None = None, noise: float = NOISE
) -> Record:
    u = draw_levels(seed) if u is None else u
    return make_record(u, a * u + 1.0 + noise * draw_noise(seed, n=u.size))


def validate(record: Record) -> tuple[Problem, Metrics, Validation, list[Finding]]:
    """Estimate a line from one record, and validate it on another."""
    context = build_context([make_line(1)], MODEL, {"a": 2.0, "b": 1.0})
    problem, estimates = context.problem, context.analysis.estimates
    metrics = compute_metrics(problem, problem.predict(context.theta[None])[0])
    validated = validate_estimates(Problem.build(MODEL, [record]), problem, estimates, {}, metrics)
    return (
        problem,
        metrics,
        validated,
        list(find_contradictions(problem, metrics, validated, estimates)),
    )


def test_data_that_agree_are_no_finding() -> None:
    _, metrics, validated, found = validate(make_line(2))
    assert found == []
    assert validated.metrics.rms == pytest.approx(metrics.rms, rel=0.2)


def test_without_validation_data_there_is_no_finding() -> None:
    problem, metrics, _, _ = validate(make_line(2))
    assert list(find_contradictions(problem, metrics, None, ())) == []


def test_data_that_their_own_mean_predicts_better_refute_every_free_estimate() -> None:
    _, _, validated, (found,) = validate(make_line(2, a=-2.0))
    assert validated.is_refuted
    assert (found.severity, found.status) == ("serious", "refuted")
    assert found.parameters == ("a", "b")
    assert found.brief == "the validation data contradict the model"
    assert found.reason
    assert f"RMS {validated.metrics.rms:.3g}" in found.text


def test_data_that_fit_clearly_worse_are_a_caution_for_the_whole() -> None:
    _, metrics, validated, (found,) = validate(make_line(2, a=1.4))
    assert metrics.fit_percent - validated.metrics.fit_percent > 20.0
    assert (found.severity, found.parameters) == ("caution", ())
    assert found.brief == "it fits the validation data worse"


def test_data_that_hardly_move_are_a_note_and_have_no_fit() -> None:
    still = make_line(2, u=np.full(400, 1.0))
    _, _, validated, (found,) = validate(still)
    assert validated.is_still
    assert np.isnan(validated.metrics.fit_percent)
    assert found.severity == "note"
    assert "hardly move" in found.text


def test_a_start_belongs_to_its_record_and_is_estimated_on_its_first_part() -> None:
    late = make_line(2)
    (y,) = late.outputs
    moved = replace(late, outputs=(replace(y, values=y.values + 0.3 * (np.arange(400) > 200)),))
    _, _, first, _ = validate(late)
    _, _, second, _ = validate(moved)
    np.testing.assert_allclose(first.simulated[0][0], second.simulated[0][0])
