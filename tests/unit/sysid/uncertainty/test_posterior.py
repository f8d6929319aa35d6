"""The posterior: exact ones of small problems, the reported intervals, several minima, limits."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import signal

from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.parse import parse_model
from sysid.residuals.series import make_whitening
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from sysid.uncertainty.estimates import Posterior
from sysid.uncertainty.posterior import (
    _compute_autocorrelation_times,
    describe_posterior,
    sample_posterior,
)
from tests.support.library.search_problems import example

LINE: dict[str, Any] = {
    "name": "line",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {"a": {"lower": 0.1, "upper": 10}, "b": {"lower": -20, "upper": 20}},
    "equations": {"x": "-x"},
    "outputs": {"y": "a*u(t) + b + x"},
    "initial": {"x": 0},
}
TRUTH = [2.0, 1.0]


def build_columns(n: int) -> FloatArray:
    return np.column_stack([np.sin(1.3 * np.arange(n)) + 0.1, np.ones(n)])


def pose(noise: FloatArray, **options: Any) -> Problem:
    columns, times = build_columns(noise.size), 0.1 * np.arange(noise.size)
    y = columns @ TRUTH + noise
    record = Record((Channel("u", times, columns[:, 0]),), (Channel("y", times, y),))
    return Problem.build(parse_model(LINE), [record], **options)


def refine(problem: Problem, *values: float) -> FloatArray:
    candidate = refine_candidates(problem, [np.array(values)])[0]
    assert candidate is not None
    return candidate.theta


def sample(problem: Problem, seed: int = 1, **limits: Any) -> tuple[Posterior, Analysis]:
    theta = refine(problem, *TRUTH)
    analysis = analyse_estimate(problem, theta)
    return sample_posterior(problem, theta, analysis, [], seed, **limits), analysis


def compare_intervals(posterior: Posterior, analysis: Analysis) -> FloatArray:
    """The posterior interval's ends minus those of the estimate, in widths of the latter."""
    ours = np.array([parameter.interval95 for parameter in posterior.parameters])
    reported = np.array([estimate.interval95 for estimate in analysis.estimates])
    return np.asarray((ours - reported) / np.ptp(reported, axis=1, keepdims=True))


def white(n: int, sd: float = 0.3) -> FloatArray:
    return sd * np.random.default_rng(1).standard_normal(n)


def test_a_linear_model_has_the_multivariate_t_distribution() -> None:
    """Mean, covariance and quantiles of Box and Tiao (1973), within their Monte Carlo errors."""
    n = 14
    problem = pose(white(n))
    posterior, analysis = sample(problem)
    assert posterior.converged
    assert describe_posterior(posterior, analysis.estimates) == []
    far = [replace(one, interval95=(-9.0, 9.0)) for one in analysis.estimates]
    (told,) = describe_posterior(posterior, far)
    assert told.count("from -9 to 9 by the standard error") == 2
    columns, y = build_columns(n), problem.records[0].outputs[0].values
    mean, squares = np.linalg.lstsq(columns, y, rcond=None)[:2]
    degrees = n - 2
    covariance = squares[0] / (degrees - 2) * np.linalg.inv(columns.T @ columns)
    deviation = np.sqrt(np.diag(covariance))
    independent = min(parameter.effective_samples for parameter in posterior.parameters)
    assert independent > 1500
    samples = posterior.samples
    error = 4.0 / np.sqrt(min(len(samples), independent))
    assert np.all(np.abs(np.mean(samples, axis=0) - mean) < error * deviation)
    np.testing.assert_allclose(np.std(samples, axis=0), deviation, rtol=0.08)
    expected = covariance[0, 1] / np.prod(deviation)
    assert posterior.correlation.matrix[0, 1] == pytest.approx(expected, abs=0.05)
    assert np.all(np.abs(compare_intervals(posterior, analysis)) < 0.03)
    medians = np.array([parameter.median for parameter in posterior.parameters])
    assert np.all(np.abs(medians - mean) < 0.1 * deviation)


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_bounds_and_scale_are_the_prior(scale: str) -> None:
    """An interval that a bound cuts off, against the sum over a grid."""
    noise = white(14, 3.0)
    problem = pose(noise, parameters={"a": {"scale": scale}, "b": {"fixed": 1.0}})
    theta = refine(problem, 2.0)
    posterior = sample_posterior(problem, theta, analyse_estimate(problem, theta), [], 1)
    places = np.linspace(0.0, 1.0, 4001)
    values = 0.1 * 100.0**places if scale == "log" else 0.1 + 9.9 * places
    u, y = build_columns(14)[:, 0], problem.records[0].outputs[0].values
    squares = np.sum(np.square(y[:, None] - 1.0 - u[:, None] * values), axis=0)
    weights = np.cumsum((squares / np.min(squares)) ** (-14 / 2))
    quantiles = np.interp([0.025, 0.5, 0.975], weights / weights[-1], values)
    (parameter,) = posterior.parameters
    found = np.array([parameter.interval95[0], parameter.median, parameter.interval95[1]])
    apart = (found - quantiles) / (quantiles[2] - quantiles[0])
    assert np.all(np.abs(apart) < 0.04)
    assert found[0] < 1.0  # near the bound at 0.1


def test_intervals_of_coloured_residuals_are_those_of_the_sandwich() -> None:
    noise = signal.lfilter([1.0], [1.0, -0.8], white(1000, 0.1))
    posterior, analysis = sample(pose(noise))
    assert analysis.uncertainty is not None
    assert analysis.uncertainty.noise_colour == "coloured"
    assert np.all(np.abs(compare_intervals(posterior, analysis)) < 0.05)


def test_intervals_under_a_robust_loss_are_those_of_the_m_estimator() -> None:
    noise = white(200)
    noise[::20] += 3.0
    posterior, analysis = sample(pose(noise, loss=Loss("soft-l1", 0.3)))
    assert np.all(np.abs(compare_intervals(posterior, analysis)) < 0.05)


def test_intervals_under_a_noise_model_are_those_of_whitened_residuals() -> None:
    noise = signal.lfilter([1.0], [1.0, -0.9], white(200, 0.1))
    problem = pose(noise, loss=Loss(noise_model="ar1"))
    whitening = make_whitening(problem, {"y": 0.95})
    columns, y = build_columns(200), problem.records[0].outputs[0].values
    theta = np.linalg.lstsq(whitening.whiten(columns.T).T, whitening.whiten(y), rcond=None)[0]
    analysis = analyse_estimate(problem, theta, whitening=whitening)
    posterior = sample_posterior(problem, theta, analysis, [], 1)
    assert np.all(np.abs(compare_intervals(posterior, analysis)) < 0.05)


def test_intervals_of_example_1_are_those_of_the_standard_errors() -> None:
    problem = example()
    theta = refine(problem, 0.2, 0.5, 5.0, 1.0)
    analysis = analyse_estimate(problem, theta)
    posterior = sample_posterior(problem, theta, analysis, [], 1)
    assert posterior.converged
    assert np.all(np.abs(compare_intervals(posterior, analysis)) < 0.05)
    assert analysis.uncertainty is not None
    expected = analysis.uncertainty.correlation
    np.testing.assert_allclose(posterior.correlation.matrix, expected, atol=0.06)


def pose_periodic() -> Problem:
    """A lag that a sine of 5 s tells up to a period, once the start is forgotten."""
    model = {
        **LINE,
        "parameters": {
            "a": {"lower": 0.1, "upper": 10},
            "L": {"lower": 0.0, "upper": 7.5, "unit": "s"},
        },
        "outputs": {"y": "a*u(t - L) + x"},
    }
    times = 0.1 * np.arange(300)
    u, delayed = (np.sin(2.0 * np.pi * (times - lag) / 5.0) for lag in (0.0, 1.33))
    y = 2.0 * delayed + white(300)
    record = Record((Channel("u", times, u),), (Channel("y", times, y),))
    return Problem.build(parse_model(model), [record], skip=100)


def test_walkers_move_between_two_minima_that_fit_as_well() -> None:
    problem = pose_periodic()
    ends = [refine(problem, 2.0, lag) for lag in (1.3, 6.3)]
    analysis = analyse_estimate(problem, ends[0])
    posterior = sample_posterior(problem, ends[0], analysis, ends, 1)
    assert posterior.converged
    share = np.mean(posterior.samples[:, 1] > 4.0)
    assert 0.4 < share < 0.6
    alone = sample_posterior(problem, ends[0], analysis, [], 1, 2000)
    assert np.all(alone.samples[:, 1] < 4.0)  # only minima that are known are sampled


def test_walkers_that_stay_in_their_minima_have_not_converged() -> None:
    """Each moves freely in its own minimum, so only the mean of all shows it."""
    chain = np.random.default_rng(1).standard_normal((400, 32, 2))
    chain[:, :16, 1] += 10.0
    times = _compute_autocorrelation_times(chain)
    assert times[0] == pytest.approx(1.0, abs=0.1)
    assert times[1] > 100.0


def test_the_autocorrelation_time_is_that_of_an_autoregression() -> None:
    noise = np.random.default_rng(1).standard_normal((4000, 32, 1))
    chain = signal.lfilter([1.0], [1.0, -0.9], noise, axis=0)
    assert _compute_autocorrelation_times(chain)[0] == pytest.approx(19.0, rel=0.1)
    assert _compute_autocorrelation_times(np.ones((50, 4, 1)))[0] == 50.0  # it does not move


def test_a_cut_chain_says_so_and_equal_seeds_give_equal_bits() -> None:
    problem = pose(white(14))
    posterior, _ = sample(problem, max_simulations=2000)
    assert posterior.evaluations <= 2000
    assert not posterior.converged
    assert "the limit of simulations ended it" in posterior.reason
    (text,) = describe_posterior(posterior)
    assert text.startswith("the samples of the posterior have not converged")
    np.random.seed(5)  # noqa: NPY002 - a chain does not depend on it
    again, _ = sample(problem, max_simulations=2000)
    assert again.samples.tobytes() == posterior.samples.tobytes()
    other, _ = sample(problem, seed=2, max_simulations=2000)
    assert other.samples.tobytes() != posterior.samples.tobytes()


def count_calls(most: int) -> Callable[[], bool]:
    calls = iter(range(most))
    return lambda: next(calls, None) is None


def test_a_chain_ends_at_the_time_limit() -> None:
    posterior, _ = sample(pose(white(14)), is_late=count_calls(50))
    assert posterior.steps == 51
    assert "the time limit ended it" in posterior.reason


@pytest.mark.parametrize("limits", [{"max_simulations": 100}, {"is_late": count_calls(5)}])
def test_too_few_steps_give_no_samples_but_a_reason(limits: dict[str, Any]) -> None:
    posterior, _ = sample(pose(white(14)), **limits)
    assert posterior.parameters == ()
    assert posterior.samples.shape == (0, 2)
    (text,) = describe_posterior(posterior)
    assert text.startswith("no posterior was sampled: the limits of simulations and time")


def test_without_noise_or_standard_errors_there_is_a_reason() -> None:
    exact, _ = sample(pose(np.zeros(14)))
    assert exact.reason == "the simulation equals the records up to rounding"
    short, _ = sample(pose(white(2)))
    assert short.reason == "2 samples are not more than 2 parameters"
    assert short.evaluations == 0


def test_samples_that_fit_better_than_the_estimate_are_reported() -> None:
    problem = pose(white(200))
    theta = refine(problem, *TRUTH) + np.array([0.15, 0.0])
    posterior = sample_posterior(problem, theta, analyse_estimate(problem, theta), [], 1, 2000)
    assert posterior.gain > 10.0
    assert "fit clearly better than the estimate" in describe_posterior(posterior)[-1]


def test_equal_parameters_keep_one_order() -> None:
    """Two that can be exchanged: every sample has the larger one first."""
    model = {
        **LINE,
        "parameters": {name: {"lower": 0.1, "upper": 10} for name in ("a", "b")},
        "outputs": {"y": "(a + b)*u(t) + a*b + x"},
    }
    times, u = 0.1 * np.arange(100), build_columns(100)[:, 0]
    y = 4.0 * u + 3.9 + white(100)
    record = Record((Channel("u", times, u),), (Channel("y", times, y),))
    problem = Problem.build(parse_model(model), [record])
    theta = refine(problem, 2.5, 1.5)
    analysis = replace(analyse_estimate(problem, theta), exchanges=(((0,), (1,)),))
    posterior = sample_posterior(problem, theta, analysis, [], 1, 3000)
    assert np.all(posterior.samples[:, 0] >= posterior.samples[:, 1])
