"""Standard errors, intervals and criteria of models that are linear, against closed forms."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.parse import parse_model
from sysid.residuals.series import make_whitening
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from sysid.uncertainty.local_estimates import LocalStatistics, make_estimates
from sysid.uncertainty.profile_likelihood import compute_profile
from tests.support.library.search_problems import example
from tests.support.library.small_models import LINE

N = 14
TIMES = 0.1 * np.arange(N)
INPUT = np.sin(1.3 * np.arange(N)) + 0.1 * np.arange(N)
COLUMNS = np.column_stack([INPUT, np.ones(N)])


def draw_output(seed: int = 1, sd: float = 0.3) -> FloatArray:
    noise = np.random.default_rng(seed).normal(0.0, sd, N)
    return np.asarray(2.0 * INPUT + 1.0 + noise)


def pose(y: FloatArray | None = None, **options: Any) -> Problem:
    values = draw_output() if y is None else y
    record = Record((Channel("u", TIMES, INPUT),), (Channel("y", TIMES, values),))
    return Problem.build(parse_model(LINE), [record], **options)


def fit(problem: Problem) -> FloatArray:
    start = np.clip(1.0, problem.evaluator.lower, problem.evaluator.upper)
    candidate = refine_candidates(problem, [start])[0]
    assert candidate is not None
    return candidate.theta


def list_stderr(analysis: Analysis) -> list[float | None]:
    return [estimate.stderr for estimate in analysis.estimates]


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_a_line_has_the_covariance_and_the_intervals_of_the_textbook(scale: str) -> None:
    problem = pose(parameters={"a": {"scale": scale}})
    y = problem.records[0].outputs[0].values
    theta, squares = np.linalg.lstsq(COLUMNS, y, rcond=None)[:2]
    variance = float(squares[0]) / (N - 2)
    covariance = variance * np.linalg.inv(COLUMNS.T @ COLUMNS)
    analysis = analyse_estimate(problem, fit(problem))
    assert analysis.uncertainty is not None
    np.testing.assert_allclose(analysis.uncertainty.covariance, covariance, rtol=1e-5)
    r = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
    np.testing.assert_allclose(analysis.uncertainty.correlation, [[1, r], [r, 1]], rtol=1e-5)
    assert analysis.uncertainty.noise_sd == pytest.approx(np.sqrt(variance))
    half = float(stats.t.ppf(0.975, N - 2)) * np.sqrt(np.diag(covariance))
    for estimate, value, h in zip(analysis.estimates, theta, half, strict=True):
        assert estimate.interval95 == pytest.approx((value - h, value + h), rel=1e-4)


def test_two_outputs_have_the_covariance_of_weighted_least_squares() -> None:
    model = parse_model({**LINE, "outputs": {"y": "a*u(t) + b + x", "z": "a*u(t) - b + x"}})
    columns = np.vstack([COLUMNS, COLUMNS * [1.0, -1.0]])
    weight, sd = np.repeat([1.0, 4.0], N), np.repeat([0.4, 0.1], N)
    values = columns @ [2.0, 1.0] + sd * np.random.default_rng(3).standard_normal(2 * N)
    outputs = Channel("y", TIMES, values[:N]), Channel("z", TIMES, values[N:])
    record = Record((Channel("u", TIMES, INPUT),), outputs)
    problem = Problem.build(model, [record], weights={"y": 1.0, "z": 4.0})
    scaled = weight[:, None] * columns
    theta, squares = np.linalg.lstsq(scaled, weight * values, rcond=None)[:2]
    analysis = analyse_estimate(problem, fit(problem))
    assert analysis.uncertainty is not None
    assert [e.value for e in analysis.estimates] == pytest.approx(theta.tolist(), rel=1e-6)
    variance = float(squares[0]) / (2 * N - 2)
    covariance = variance * np.linalg.inv(scaled.T @ scaled)
    np.testing.assert_allclose(analysis.uncertainty.covariance, covariance, rtol=1e-5)


def test_a_robust_line_has_the_covariance_of_an_m_estimator() -> None:
    y = draw_output()
    y[4] += 3.0
    s = 0.2
    problem = pose(y, loss=Loss("soft-l1", s))
    theta = fit(problem)
    error = COLUMNS @ theta - y
    root = 1.0 + (error / s) ** 2
    bread = np.linalg.inv((COLUMNS.T * root**-1.5) @ COLUMNS)
    filling = (COLUMNS.T * error**2 / root) @ COLUMNS
    analysis = analyse_estimate(problem, theta)
    assert analysis.uncertainty is not None
    np.testing.assert_allclose(
        analysis.uncertainty.covariance, N / (N - 2) * bread @ filling @ bread, rtol=1e-5
    )
    noise = 1.4826 * float(np.median(np.abs(error)))
    assert analysis.uncertainty.noise_sd == pytest.approx(noise)


def test_criteria_are_those_of_a_gaussian_likelihood() -> None:
    problem = pose()
    theta = fit(problem)
    error = COLUMNS @ theta - problem.records[0].outputs[0].values
    likelihood = float(np.sum(stats.norm.logpdf(error, scale=np.sqrt(np.mean(error**2)))))
    criteria, count = analyse_estimate(problem, theta).criteria, 3
    assert criteria.aic == pytest.approx(2 * count - 2 * likelihood)
    assert criteria.aicc == pytest.approx(criteria.aic + 2 * count * (count + 1) / (N - count - 1))
    assert criteria.bic == pytest.approx(count * np.log(N) - 2 * likelihood)


def test_under_a_noise_model_criteria_and_intervals_are_those_of_correlated_noise() -> None:
    problem, theta, time = pose(), np.array([2.0, 1.0]), 0.25
    whitening = make_whitening(problem, {"y": time})
    analysis = analyse_estimate(problem, theta, whitening=whitening)
    error = COLUMNS @ theta - problem.records[0].outputs[0].values
    correlation = np.exp(-np.abs(TIMES[:, None] - TIMES) / time)
    variance = float(error @ np.linalg.solve(correlation, error)) / N
    likelihood = stats.multivariate_normal(cov=variance * correlation).logpdf(error)
    assert analysis.criteria.aic == pytest.approx(2 * 4 - 2 * float(likelihood))
    a = float(np.exp(-0.1 / time))
    degrees = 1.0 + (N - 1) * (1.0 - a) / (1.0 + a) - 2.0
    assert 1.0 < degrees < 4.0
    for estimate in analysis.estimates:
        assert estimate.stderr is not None
        assert estimate.interval95 is not None
        half = 0.5 * (estimate.interval95[1] - estimate.interval95[0])
        assert half / estimate.stderr == pytest.approx(float(stats.t.ppf(0.975, degrees)))


@pytest.mark.parametrize("upper", [5.0, 0.8])
def test_the_linear_model_predicts_the_sum_of_squares_also_at_a_bound(upper: float) -> None:
    problem = pose(parameters={"b": {"upper": upper}})
    theta = fit(problem)
    assert (theta[1] == pytest.approx(upper)) == (upper < 1.0)
    linear = analyse_estimate(problem, theta).linear_model
    assert linear is not None
    moves = np.array([[0.3, 0.0], [0.0, -0.2], [-0.4, -0.5]])
    base, *others = problem.evaluate_fitness(np.vstack([theta, theta + moves]))
    expected = (np.array(others) / base) ** 2 - 1.0
    np.testing.assert_allclose(linear.predict_relative_increase(moves), expected, rtol=1e-4)


def test_the_correlation_of_sensitivities_is_that_of_white_residuals() -> None:
    n = 600
    times, random = 0.1 * np.arange(n), np.random.default_rng(2)
    u = np.cumsum(random.standard_normal(n)) / 10 + 2.0
    noise = np.zeros(n)
    for k in range(1, n):
        noise[k] = 0.8 * noise[k - 1] + random.standard_normal()
    record = Record((Channel("u", times, u),), (Channel("y", times, 2.0 * u + 1.0 + noise),))
    problem = Problem.build(parse_model(LINE), [record])
    uncertainty = analyse_estimate(problem, fit(problem)).uncertainty
    assert uncertainty is not None
    assert uncertainty.noise_colour == "coloured"
    inverse = np.linalg.inv([[u @ u, np.sum(u)], [np.sum(u), n]])
    r = inverse[0, 1] / np.sqrt(inverse[0, 0] * inverse[1, 1])
    assert uncertainty.sensitivity_correlation[0, 1] == pytest.approx(r, rel=1e-5)
    assert abs(uncertainty.correlation[0, 1] - r) > 1e-3


@pytest.mark.parametrize(("tie", "quantile"), [("3*a", 2.0), ("3*b", 4.0), ("a + 2*b", 4.0)])
def test_a_tied_parameter_has_the_widest_quantile_of_what_it_is_tied_to(
    tie: str, quantile: float
) -> None:
    parameters = {**LINE["parameters"], "c": {"lower": -20, "upper": 20}}
    model = parse_model({**LINE, "parameters": parameters, "outputs": {"y": "a*u(t) + b + x + c"}})
    record = Record((Channel("u", TIMES, INPUT),), (Channel("y", TIMES, draw_output()),))
    problem = Problem.build(model, [record], parameters={"c": {"tied": tie}})
    covariance = np.array([[0.04, -0.03], [-0.03, 0.09]])
    statistics = LocalStatistics(
        np.array([2.0, 1.0]),
        ("identified", "identified"),
        covariance,
        np.array([2.0, 4.0]),
        np.zeros(2, dtype=np.bool_),
        (),
        np.zeros((0, 2)),
        np.ones(2),
        np.zeros(2, dtype=np.bool_),
    )
    [estimate] = [e for e in make_estimates(problem, statistics) if e.name == "c"]
    slope = {"3*a": [3.0, 0.0], "3*b": [0.0, 3.0], "a + 2*b": [1.0, 2.0]}[tie]
    stderr = float(np.sqrt(slope @ covariance @ slope))
    value = float(np.dot(slope, [2.0, 1.0]))
    assert estimate.stderr == pytest.approx(stderr, rel=1e-6)
    half = quantile * stderr
    assert estimate.interval95 == pytest.approx((value - half, value + half), rel=1e-6)


@pytest.mark.parametrize("name", ["a", "b"])
def test_the_scale_of_the_search_does_not_change_a_profile(name: str) -> None:
    linear = compute_profile(pose(), np.array([2.0, 1.0]), name)
    log = compute_profile(pose(parameters={"a": {"scale": "log"}}), np.array([2.0, 1.0]), name)
    assert linear.interval[0] is not None
    assert log.estimate == pytest.approx(linear.estimate, rel=1e-6)
    assert log.interval == pytest.approx(linear.interval, rel=2e-3)


def test_a_budget_that_just_suffices_gives_standard_errors() -> None:
    theta = np.array([0.2, 0.5, 5.0, 1.0])
    whole = analyse_estimate(example(), theta)
    assert whole.evaluations == 1 + 2 * 4
    just = analyse_estimate(example(), theta, whole.evaluations)
    assert list_stderr(just) == list_stderr(whole)
    assert None not in list_stderr(just)
    assert list_stderr(analyse_estimate(example(), theta, whole.evaluations - 1)) == [None] * 4


def test_a_parameter_that_the_data_pull_beyond_its_bound_is_not_unidentifiable() -> None:
    """Its standard error is as large as its range, because the bound leaves large residuals."""
    times = 0.1 * np.arange(80)
    u = np.sin(1.3 * np.arange(80))
    noise = np.random.default_rng(1).normal(0.0, 3.0, 80)
    record = Record((Channel("u", times, u),), (Channel("y", times, 2.0 * u + 4.0 + noise),))
    bounds = {"b": {"lower": 0.0, "upper": 0.1}}
    problem = Problem.build(parse_model(LINE), [record], parameters=bounds)
    b = analyse_estimate(problem, fit(problem)).estimates[1]
    assert b.value == pytest.approx(0.1)
    assert b.stderr is not None
    assert b.stderr > 0.1
    assert b.status == "at bound"


def test_the_possible_gain_is_what_a_step_inside_the_bounds_removes() -> None:
    free = pose()
    least = float(free.evaluate_fitness(fit(free)[None])[0])
    for theta in (np.array([2.3, 1.0]), np.array([1.5, 2.0])):
        share = 1.0 - (least / float(free.evaluate_fitness(theta[None])[0])) ** 2
        assert analyse_estimate(free, theta).possible_gain == pytest.approx(share, rel=1e-4)
    for bounds in ({"upper": 0.2}, {"lower": 2.5}):
        held = pose(parameters={"b": bounds})
        assert analyse_estimate(held, fit(held)).possible_gain < 1e-9
        inside = np.array([fit(held)[0], 0.1 if "upper" in bounds else 2.6])
        assert analyse_estimate(held, inside).possible_gain > 0.01
    at_lower = pose(parameters={"b": {"lower": 0.5}})
    assert analyse_estimate(at_lower, np.array([2.0, 0.5])).possible_gain > 0.1
