"""Records of unequal noise count by their own variances, which are estimated with the rest."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.parse import parse_model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem, compute_metrics
from sysid.uncertainty.analysis import analyse_estimate, compute_criteria
from sysid.uncertainty.profile_likelihood import compute_profile
from sysid.uncertainty.unequal_noise import (
    ReweightedFit,
    describe_unequal_noise,
    fit_unequal_noise,
)
from tests.support.library.small_models import LINE
from tests.support.profiles import draw_seeds
from tests.support.random_bounds import bound_count

MODEL = parse_model(LINE)
TRUTH = np.array([2.0, 1.0])


def draw(length: int, deviation: float, seed: int) -> tuple[Record, FloatArray]:
    """A record of the line and its regressors."""
    random = np.random.default_rng(seed)
    times, u = 0.1 * np.arange(length), random.normal(size=length)
    columns = np.column_stack([u, np.ones(length)])
    y = columns @ TRUTH + deviation * random.standard_normal(length)
    return Record((Channel("u", times, u),), (Channel("y", times, y),)), columns


def pose(*records: tuple[Record, FloatArray], **options: Any) -> Problem:
    return Problem.build(MODEL, [record for record, _ in records], **options)


def fit_line(problem: Problem) -> tuple[FloatArray, ReweightedFit | None]:
    end = refine_candidates(problem, [TRUTH])[0]
    assert end is not None
    return end.theta, fit_unequal_noise(problem, end.theta)


def test_parameters_and_variances_are_those_of_restricted_likelihood() -> None:
    records = draw(60, 0.05, 1), draw(90, 1.0, 2)
    _, found = fit_line(pose(*records))
    assert found is not None
    # Aitken's estimate and the variances in turn, until nothing moves
    variances = np.ones(2)
    data = [(columns, record.outputs[0].values) for record, columns in records]
    for _ in range(60):
        blocks = [x.T @ x / v for (x, _), v in zip(data, variances, strict=True)]
        right = sum(x.T @ y / v for (x, y), v in zip(data, variances, strict=True))
        inverse = np.linalg.inv(sum(blocks))
        theta = inverse @ right
        variances = np.array(
            [
                np.sum((y - x @ theta) ** 2) / (y.size - np.trace(inverse @ block))
                for (x, y), block in zip(data, blocks, strict=True)
            ]
        )
    assert found.theta == pytest.approx(theta, rel=1e-4)
    (first,), (second,) = found.problem.settings.deviations or ((1.0,), (1.0,))
    assert second / first == pytest.approx(np.sqrt(variances[1] / variances[0]), rel=0.02)
    stderr = [one.stderr for one in analyse_estimate(found.problem, found.theta).estimates]
    assert stderr == pytest.approx(np.sqrt(np.diag(inverse)), rel=0.02)


def test_a_noisy_second_record_never_makes_the_errors_larger() -> None:
    alone, noisy = draw(80, 0.02, 3), draw(80, 0.6, 4)
    theta, nothing = fit_line(pose(alone))
    assert nothing is None
    before = analyse_estimate(pose(alone), theta).estimates
    _, joint = fit_line(pose(alone, noisy))
    assert joint is not None
    after = analyse_estimate(joint.problem, joint.theta).estimates
    for one, other in zip(after, before, strict=True):
        assert (one.stderr or 0.0) < 1.02 * (other.stderr or 0.0)


def test_intervals_under_unequal_noise_cover_the_truth() -> None:
    held = []
    for seed in draw_seeds(gate=40, night=400):
        _, found = fit_line(pose(draw(40, 0.1, 2 * seed), draw(120, 1.0, 2 * seed + 1)))
        assert found is not None
        for one, true in zip(
            analyse_estimate(found.problem, found.theta).estimates, TRUTH, strict=True
        ):
            assert one.interval95 is not None
            held.append(one.interval95[0] <= true <= one.interval95[1])
    least, most = bound_count(len(held), 0.94, 0.97)
    assert least <= sum(held) <= most


def test_a_sensor_at_rest_says_nothing_of_the_noise() -> None:
    moving, (record, columns) = (draw(60, 0.05, 5), draw(60, 1.0, 6)), draw(60, 0.0, 11)
    values = zip((*record.inputs, *record.outputs), (0.0, 1.0), strict=True)
    u, y = (replace(channel, values=np.full(60, value)) for channel, value in values)
    resting = Record((u,), (y,)), columns
    for others in (moving, moving[:1]):
        theta, found = fit_line(pose(*others, resting))
        assert (found is None) == (len(others) == 1)
        if found is not None:
            deviations = np.ravel(found.problem.settings.deviations or ())
            assert deviations[0] < deviations[2] < deviations[1]
            assert found.theta[0] == pytest.approx(2.0, abs=0.05)
        assert np.all(np.isfinite(theta))


def test_j_and_fit_stay_those_of_equal_weights() -> None:
    problem = pose(draw(60, 0.05, 5), draw(60, 1.0, 6))
    _, found = fit_line(problem)
    assert found is not None
    simulated = found.problem.predict(found.theta[None])[0]
    weighed, plain = (compute_metrics(one, simulated) for one in (found.problem, problem))
    assert weighed == plain
    assert found.rms == pytest.approx(plain.rms, rel=0.01)
    (note,) = describe_unequal_noise(found.problem, weighed.channels)
    assert "y of experiment 1" in note
    assert "y of experiment 2" in note


def test_criteria_of_unequal_noise_are_those_of_its_likelihood() -> None:
    problem = pose(draw(60, 0.05, 5), draw(60, 1.0, 6))
    _, found = fit_line(problem)
    assert found is not None
    rows, weight = found.problem.scored_rows, found.problem.evaluator.weight
    error = found.problem.predict(found.theta[None])[0] - found.problem.evaluator.measured
    criteria = compute_criteria(found.problem, (weight * error)[rows])
    variances = np.array([np.mean(part**2) for part in (error[:60], error[60:])])
    expected = 60 * np.sum(np.log(2 * np.pi * variances) + 1) + 2 * (2 + 2)
    assert criteria.aic == pytest.approx(expected, abs=0.1)


def test_equal_noise_given_weights_and_robust_losses_keep_their_weights() -> None:
    equal, unequal = (draw(60, 0.3, 7), draw(60, 0.3, 8)), (draw(60, 0.05, 5), draw(60, 1.0, 6))
    assert fit_line(pose(*equal))[1] is None
    assert fit_line(pose(*unequal, weights={"y": [1.0, 1.0]}))[1] is None
    assert fit_line(pose(*unequal, loss=Loss("soft-l1", 0.5)))[1] is None


def test_weights_by_experiment_are_those_of_weighted_least_squares() -> None:
    records = draw(40, 0.1, 9), draw(40, 0.1, 10)
    theta, _ = fit_line(pose(*records, weights={"y": [3.0, 0.5]}))
    columns = np.vstack([3.0 * records[0][1], 0.5 * records[1][1]])
    values = np.concatenate(
        [3.0 * records[0][0].outputs[0].values, 0.5 * records[1][0].outputs[0].values]
    )
    assert theta == pytest.approx(np.linalg.lstsq(columns, values, rcond=None)[0], rel=1e-6)
    with pytest.raises(InvalidSettings, match="/weights/y: found 3 weights; need one for each"):
        pose(*records, weights={"y": [1.0, 1.0, 1.0]})
    with pytest.raises(InvalidSettings, match="/weights/y: -1 is not a weight"):
        pose(*records, weights={"y": [1.0, -1]})


def test_a_profile_weighs_the_residuals_as_the_estimate_does() -> None:
    problem = pose(draw(60, 0.05, 5), draw(60, 1.0, 6))
    plain, found = fit_line(problem)
    assert found is not None
    profile = compute_profile(problem, plain, "a")
    assert profile.estimate == pytest.approx(found.theta[0], rel=1e-4)
    interval = analyse_estimate(found.problem, found.theta).estimates[0].interval95
    assert profile.interval == pytest.approx(interval, rel=0.01)
