"""Profile likelihood: against the t interval where the model is linear, and where it is not."""

import numpy as np
import pytest

from sysid.core.distributions import CHI_SQUARE_95
from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.profile_likelihood import compute_profile
from tests.support.library.search_problems import DUFFING, STEP, example, noisy, record

TRUTH = np.array([DUFFING[name] for name in ("c", "L", "b", "a")])


def build_linear(
    n: int = 400, sd: float = 0.3, pole: float = 0.0, **bounds: float
) -> tuple[Problem, FloatArray]:
    """A straight line in sin and cos of the sample number, and its estimate.

    With a `pole` the input and the noise are of the first order.
    """
    rng = np.random.default_rng(5)
    times = 0.1 * np.arange(n)
    interval = {"lower": -5.0, "upper": 5.0} | bounds
    model = parse_model(
        {
            "name": "line",
            "form": "difference",
            "inputs": {"u": "1"},
            "states": {"x": "1"},
            "parameters": {"p": interval, "q": {"lower": -5, "upper": 5}},
            "equations": {"x": "p*u(k) + q*sin(k) + q*u(k)"},
            "outputs": {"y": "x"},
            "initial": {"x": 0},
        }
    )
    u = rng.standard_normal(n)
    noise = rng.standard_normal(n)
    for k in range(1, n if pole else 0):
        u[k] += pole * u[k - 1]
        noise[k] += pole * noise[k - 1]
    y: FloatArray = u + 0.5 * np.sin(np.arange(n)) + 0.5 * u + sd * noise
    data = Record((Channel("u", times, u),), (Channel("y", times, y),))
    problem = Problem.build(model, [data], skip=1)
    end = refine_candidates(problem, [np.array([0.5, 0.5])])[0]
    assert end is not None
    return problem, end.theta


@pytest.mark.parametrize("name", ["p", "q"])
def test_where_the_model_is_linear_the_interval_is_that_of_the_t_distribution(name: str) -> None:
    problem, theta = build_linear()
    found = compute_profile(problem, theta, name)
    estimate = next(e for e in analyse_estimate(problem, theta).estimates if e.name == name)
    assert estimate.interval95 is not None
    assert estimate.stderr is not None
    for end, expected in zip(found.interval, estimate.interval95, strict=True):
        assert end == pytest.approx(expected, abs=0.02 * estimate.stderr)


@pytest.mark.parametrize("name", ["p", "q"])
def test_where_the_residuals_are_coloured_profile_and_standard_error_mean_the_same(
    name: str,
) -> None:
    problem, theta = build_linear(pole=0.8)
    analysis = analyse_estimate(problem, theta)
    assert analysis.uncertainty is not None
    assert analysis.uncertainty.noise_colour == "coloured"
    [estimate] = [e for e in analysis.estimates if e.name == name]
    found = compute_profile(problem, theta, name)
    assert estimate.interval95 is not None
    assert estimate.stderr is not None
    for end, expected in zip(found.interval, estimate.interval95, strict=True):
        assert end == pytest.approx(expected, abs=0.05 * estimate.stderr)


def test_the_ratio_is_that_of_the_sums_of_squares_with_the_others_at_their_best() -> None:
    problem, theta = build_linear()
    found = compute_profile(problem, theta, "p", points=7)
    u = problem.records[0].inputs[0].values[1:]
    y = problem.records[0].outputs[0].values[1:]
    other = np.sin(np.arange(1, y.size + 1)) + u
    left = np.array([y - v * u for v in found.values])
    best = left @ other / (other @ other)
    sums = np.sum((left - best[:, None] * other) ** 2, axis=1)
    np.testing.assert_allclose(found.others[:, 0], best, rtol=1e-5)
    expected = y.size * np.log(sums / sums.min())
    np.testing.assert_allclose(found.likelihood_ratio, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["c", "L", "b", "a"])
def test_intervals_of_example_1_cover_the_truth(name: str) -> None:
    problem = example()
    end = refine_candidates(
        problem, [np.array([DUFFING[p.name] for p in problem.free_parameters])]
    )[0]
    assert end is not None
    found = compute_profile(problem, end.theta, name, points=11)
    low, high = found.interval
    assert low is not None
    assert high is not None
    assert low < DUFFING[name] < high
    assert low < found.estimate < high
    assert found.is_complete
    assert np.all(np.diff(found.values) > 0)
    assert found.likelihood_ratio.min() == 0.0
    assert found.likelihood_ratio[0] > CHI_SQUARE_95 < found.likelihood_ratio[-1]


def test_an_end_beyond_the_bound_is_open() -> None:
    problem, theta = build_linear(upper=1.001)
    found = compute_profile(problem, theta, "p")
    assert found.interval[0] is not None
    assert found.interval[1] is None
    assert found.values[-1] == pytest.approx(1.001)


def test_a_profile_that_is_stopped_says_so() -> None:
    problem, theta = build_linear()
    found = compute_profile(problem, theta, "p", should_stop=lambda: True)
    assert not found.is_complete
    assert found.interval == (None, None)


def test_what_cannot_be_profiled_is_refused() -> None:
    problem, theta = build_linear()
    with pytest.raises(InvalidSettings, match="no free parameter 'r'"):
        compute_profile(problem, theta, "r")
    with pytest.raises(InvalidSettings, match="need 3 or more"):
        compute_profile(problem, theta, "p", points=2)


@pytest.mark.parametrize("name", ["c", "L", "b", "a"])
def test_intervals_of_example_1_are_nearly_those_of_the_covariance(name: str) -> None:
    found = compute_profile(example(), TRUTH, name)
    end = refine_candidates(example(), [TRUTH])[0]
    assert end is not None
    [error] = [e.stderr for e in analyse_estimate(example(), end.theta).estimates if e.name == name]
    assert error is not None
    expected = (found.estimate - 1.96 * error, found.estimate + 1.96 * error)
    assert found.interval == pytest.approx(expected, abs=0.1 * error)


def test_where_the_profile_is_begun_does_not_matter() -> None:
    problem, theta = build_linear()
    beside = compute_profile(problem, theta + np.array([0.3, -0.2]), "p")
    there = compute_profile(problem, theta, "p")
    assert beside.interval == pytest.approx(there.interval, rel=1e-4)
    assert beside.estimate == pytest.approx(there.estimate, rel=1e-6)


def test_factors_of_one_product_have_open_ends() -> None:
    times = STEP * np.arange(100)
    u = np.cos(times)
    model = parse_model(
        {
            "name": "product",
            "form": "difference",
            "inputs": {"u": "1"},
            "states": {"x": "1"},
            "parameters": {"g": {"lower": 0.5, "upper": 2}, "h2": {"lower": 0.1, "upper": 10}},
            "equations": {"x": "g*h2*u(k)"},
            "outputs": {"y": "x"},
            "initial": {"x": 0},
        }
    )
    y = u + 0.1 * np.random.default_rng(1).standard_normal(times.size)
    data = Record((Channel("u", times, u),), (Channel("y", times, y),))
    found = compute_profile(Problem.build(model, [data], skip=1), np.array([1.0, 1.0]), "g")
    assert found.interval == (None, None)
    assert found.values[[0, -1]] == pytest.approx([0.5, 2.0])
    assert np.all(found.likelihood_ratio < 1e-6)
    assert found.values * found.others[:, 0] == pytest.approx(np.ones(found.values.size), abs=0.1)


def test_the_interval_of_a_rounded_lag_holds_its_plateau() -> None:
    solver = {"history": "constant", "interpolation": "nearest"}
    model = load_model({**load_model("duffing-eq16").document, "solver": solver})
    problem = Problem.build(model, [record(noisy())])
    low, high = compute_profile(problem, TRUTH, "L").interval
    assert low is not None
    assert high is not None
    assert low <= 0.49 + 1e-3
    assert high >= 0.51 - 1e-3
    assert high - low < 3 * STEP


def test_the_ratio_of_a_robust_loss_is_scaled_to_its_standard_errors() -> None:
    y = noisy()
    y[::20] += 0.2
    problem = Problem.build(load_model("duffing-eq16"), [record(y)], loss=Loss("soft-l1", 0.01))
    end = refine_candidates(problem, [TRUTH])[0]
    assert end is not None
    found = compute_profile(problem, end.theta, "b")
    [error] = [e.stderr for e in analyse_estimate(problem, end.theta).estimates if e.name == "b"]
    low, high = found.interval
    assert low is not None
    assert high is not None
    assert error is not None
    assert high - low == pytest.approx(2 * 1.96 * error, rel=0.15)


def test_a_record_without_residuals_has_no_profile() -> None:
    with pytest.raises(InvalidRecord, match="needs residuals"):
        compute_profile(example(sd=0.0), TRUTH, "b")


def test_as_many_samples_as_parameters_have_no_profile() -> None:
    problem = Problem.build(load_model("duffing-eq16"), [record(noisy())], skip=296)
    with pytest.raises(InvalidRecord, match="4 samples are not more than 4"):
        compute_profile(problem, TRUTH, "b")
