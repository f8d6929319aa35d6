"""Averages over sizes of noise, beside generalised least squares with dense matrices."""

import numpy as np
import pytest

from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.intervals import Alternative, AverageOverNoise, compose_interval
from sysid.uncertainty.noise_sizes import NoisePoints, explore_noise_sizes
from tests.support.library.small_models import LINE

PERIOD, SAMPLES = 0.5, 50
LOAD = Loss(noise_model="load")
DRIFTING_LINE = {
    **LINE,
    "solver": {"substeps": 8},
    "noise": {"load": {"y": "estimate"}},
}
"""A straight line in the input, whose sensor drifts: linear regression with coloured noise."""


def build_line() -> tuple[Problem, FloatArray, FloatArray]:
    """The problem, its regressors (N, 2) and its measured values."""
    random = np.random.default_rng(7)
    times = PERIOD * np.arange(SAMPLES)
    u = random.normal(size=SAMPLES) + np.linspace(0, 2, SAMPLES)
    drift = np.zeros(SAMPLES)
    for k in range(1, SAMPLES):
        drift[k] = 0.95 * drift[k - 1] + 0.1 * random.normal()
    y = 1.5 * u - 0.7 + drift + 0.1 * random.normal(size=SAMPLES)
    record = Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))
    columns = np.column_stack([u, np.ones(SAMPLES)])
    return Problem.build(parse_model(DRIFTING_LINE), [record], loss=LOAD), columns, y


def fit_dense(
    sizes: FloatArray, columns: FloatArray, y: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Restricted log-likelihood, values and standard errors, for a load and its time."""
    load, time = sizes
    lags = PERIOD * np.abs(np.subtract.outer(np.arange(SAMPLES), np.arange(SAMPLES)))
    matrix = np.eye(SAMPLES) + load**2 * np.exp(-lags / time)
    weighted = np.linalg.solve(matrix, columns)
    normal = columns.T @ weighted
    values = np.linalg.solve(normal, weighted.T @ y)
    error = y - columns @ values
    least = float(error @ np.linalg.solve(matrix, error))
    degrees = SAMPLES - columns.shape[1]
    logs = [np.linalg.slogdet(one)[1] for one in (matrix, normal)]
    stderrs = np.sqrt(least / degrees * np.diag(np.linalg.inv(normal)))
    return -0.5 * (degrees * np.log(least) + sum(logs)), values, stderrs


def explore(most: int | None = None) -> tuple[NoisePoints, FloatArray, FloatArray]:
    """Explore around values near the truth; with the regressors and the measured values."""
    problem, columns, y = build_line()
    theta = np.array([1.5, -0.7, 2.0, 8.0])
    covariance = np.diag([0.01, 0.1, 1.0, 30.0])
    assert problem.free_names == ("a", "b", "load[y]", "tau[y]")
    return explore_noise_sizes(problem, theta, covariance, most), columns, y


def test_every_point_is_that_of_dense_generalised_least_squares() -> None:
    found, columns, y = explore()
    assert found.names == ("a", "b")
    assert len(found.points) > 8
    expected = [fit_dense(point.sizes, columns, y) for point in found.points]
    differences = [
        point.log_likelihood - float(np.sum(np.log(point.sizes))) - one[0]  # all as probable
        for point, one in zip(found.points, expected, strict=True)
    ]
    np.testing.assert_allclose(differences, differences[0], atol=1e-4)
    for point, (_, values, stderrs) in zip(found.points, expected, strict=True):
        np.testing.assert_allclose(point.values, values, atol=1e-4)
        np.testing.assert_allclose(point.stderrs, stderrs, rtol=1e-3)


def test_points_end_where_the_likelihood_is_small_and_the_budget_where_it_is_spent() -> None:
    found, *_ = explore()
    values = [point.log_likelihood for point in found.points]
    assert max(values) - min(values) < 4.5
    assert explore(most=0)[0].average() == {}
    limited = explore(most=found.evaluations // 2)[0]
    assert limited.evaluations <= found.evaluations // 2
    assert 0 < len(limited.points) < len(found.points)


def test_there_is_nothing_to_average_without_a_free_size() -> None:
    problem, *_ = build_line()
    fixed = problem.rebuild(parameters={"load[y]": {"fixed": 2.0}, "tau[y]": {"fixed": 8.0}})
    assert explore_noise_sizes(fixed, np.array([1.5, -0.7]), np.eye(2)).average() == {}
    white = problem.rebuild(loss=Loss(noise_model="white"))
    assert explore_noise_sizes(white, np.array([1.5, -0.7]), np.eye(2)).average() == {}


def test_an_average_widens_an_estimate_and_never_narrows_it() -> None:
    known = Estimate("a", "1", 1.0, -5.0, 5.0, 0.1, (0.8, 1.2), "identified")
    alternatives = (Alternative(1.0, 1.0, 0.1), Alternative(1.0, 1.4, 0.2))
    wider = compose_interval(known, AverageOverNoise(alternatives))
    assert wider.stderr == pytest.approx(np.sqrt(0.5 * (0.01 + 0.04) + 0.04))
    assert wider.interval95 is not None
    assert wider.interval95[0] <= 0.8
    assert wider.interval95[1] > 1.6
    narrow = compose_interval(known, AverageOverNoise((Alternative(1.0, 1.0, 0.01),)))
    assert (narrow.stderr, narrow.interval95) == (0.1, (0.8, 1.2))
