"""Standard errors under coloured residuals, against repetition and against theory."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import load_model
from sysid.residuals import sandwich
from sysid.residuals.autocorrelation import space_residuals
from sysid.residuals.sandwich import Sandwich, estimate_sandwich, estimate_spectrum_root
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from tests.support.library.search_problems import DUFFING, noisy, record
from tests.support.profiles import draw_seeds
from tests.support.random_bounds import bound_count, bound_mean

STEADY = {
    "name": "level",
    "form": "difference",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {"m": {"lower": -10, "upper": 10}},
    "equations": {"x": "m + 0*u"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}
N, POLE = 2000, 0.8


def colour_noise(n: int, pole: float, seed: int) -> FloatArray:
    """First-order noise of variance 1."""
    white = np.random.default_rng(seed).standard_normal(n + 200)
    noise = np.zeros(n + 200)
    for k in range(1, n + 200):
        noise[k] = pole * noise[k - 1] + np.sqrt(1 - pole**2) * white[k]
    return noise[200:]


def level(noise: FloatArray, **settings: object) -> Analysis:
    """The analysis of a mean."""
    times = 0.1 * np.arange(noise.size)
    data = Record((Channel("u", times, times),), (Channel("y", times, noise),))
    problem = Problem.build(load_model(STEADY), [data], skip=1, **settings)
    return analyse_estimate(problem, np.array([np.mean(noise[1:])]))


def standard_error(analysis: Analysis) -> float:
    found = analysis.estimates[0].stderr
    assert found is not None
    return found


@pytest.mark.parametrize("pole", [POLE, -0.5])
def test_the_standard_error_of_a_mean_is_that_of_its_long_run_variance(pole: float) -> None:
    found = [level(colour_noise(N, pole, seed)) for seed in draw_seeds(gate=20, night=200)]
    theory = np.sqrt((1 + pole) / (1 - pole) / N)
    errors = [standard_error(one) for one in found]
    assert np.mean(errors) == pytest.approx(theory, abs=bound_mean(errors, 0.08 * theory))
    assert all(one.uncertainty and one.uncertainty.noise_colour == "coloured" for one in found)


def test_of_white_residuals_the_covariance_is_the_plain_one() -> None:
    noise = np.random.default_rng(3).standard_normal(N)
    found = level(noise)
    assert found.uncertainty is not None
    assert found.uncertainty.noise_colour == "white"
    assert standard_error(found) == pytest.approx(np.std(noise[1:], ddof=1) / np.sqrt(N - 1))


def test_one_step_ahead_residuals_keep_the_plain_covariance() -> None:
    found = level(colour_noise(N, POLE, 0), prediction="one-step")
    assert found.uncertainty is not None
    assert found.uncertainty.noise_colour == "white"


def test_a_robust_loss_is_allowed_for_as_squares_are() -> None:
    noise = colour_noise(N, POLE, 0)
    squares, robust = level(noise), level(noise, loss=Loss("soft-l1", 10.0))
    assert standard_error(robust) == pytest.approx(standard_error(squares), rel=0.1)


def test_two_equal_halves_give_what_the_halves_say_together() -> None:
    noise = colour_noise(N, POLE, 1)
    times = 0.1 * np.arange(N)
    one = Record((Channel("u", times, times),), (Channel("y", times, noise),))
    both = Problem.build(load_model(STEADY), [one, replace(one)], skip=1)
    joint = standard_error(analyse_estimate(both, np.array([np.mean(noise[1:])])))
    assert joint == pytest.approx(standard_error(level(noise)) / np.sqrt(2), rel=5e-3)


def test_residuals_that_wander_over_the_whole_record_are_told_as_such() -> None:
    wandering = np.cumsum(np.random.default_rng(0).standard_normal(N)) / 20
    found = level(wandering - np.mean(wandering)).uncertainty
    assert found is not None
    assert found.noise_colour == "drifting"


@pytest.mark.slow
@pytest.mark.parametrize(("pole", "n"), [(0.9, 100), (0.5, 100), (0.0, 40)])
def test_the_interval_of_a_mean_holds_it_in_short_records(pole: float, n: int) -> None:
    held, seeds = 0, draw_seeds(gate=50, night=1000)
    for seed in seeds:
        estimate = level(colour_noise(n, pole, seed)).estimates[0]
        assert estimate.interval95 is not None
        held += estimate.interval95[0] <= 0.0 <= estimate.interval95[1]
    assert held >= bound_count(len(seeds), 0.9)[0]


@pytest.mark.slow
def test_intervals_hold_the_truth_where_the_noise_is_coloured() -> None:
    model, clean = load_model("duffing-eq16"), noisy(sd=0.0)
    truth = np.array(
        [DUFFING[p.name] for p in Problem.build(model, [record(clean)]).free_parameters]
    )
    held = []
    for seed in draw_seeds(gate=30, night=500):
        problem = Problem.build(model, [record(clean + 0.01 * colour_noise(clean.size, 0.7, seed))])
        end = refine_candidates(problem, [truth])[0]
        assert end is not None
        found = analyse_estimate(problem, end.theta).uncertainty
        assert found is not None
        inside = np.abs(end.theta - truth) <= 1.97 * np.sqrt(np.diag(found.covariance))
        held.append(np.mean(inside))
    assert np.mean(held) > 0.92 - bound_mean(held, 0.01)  # without R about 0.6


def unequal(
    lengths: tuple[int, ...], deviations: tuple[float, ...], seed: int = 5
) -> tuple[Problem, FloatArray]:
    """A mean of several white records, and their residuals."""
    draw = np.random.default_rng(seed)
    noise = [sd * draw.standard_normal(n) for n, sd in zip(lengths, deviations, strict=True)]
    records = [
        Record(
            (Channel("u", np.arange(1.0 * n), np.zeros(n)),),
            (Channel("y", np.arange(1.0 * n), values),),
        )
        for n, values in zip(lengths, noise, strict=True)
    ]
    problem = Problem.build(load_model(STEADY), records, skip=1)
    return problem, np.concatenate([values[1:] for values in noise])


def estimate_covariance(
    lengths: tuple[int, ...], deviations: tuple[float, ...], seed: int = 5
) -> Sandwich | None:
    problem, residuals = unequal(lengths, deviations, seed)
    return estimate_sandwich(problem, residuals, np.ones((residuals.size, 1)))


def test_records_of_one_noise_are_not_taken_for_unequal_however_long_each_is() -> None:
    seeds = draw_seeds(gate=20, night=500)
    for lengths in ((41, 4001), (4001, 41)):
        equal = sum(estimate_covariance(lengths, (1.0, 1.0), seed) is None for seed in seeds)
        assert equal >= bound_count(len(seeds), 0.99)[0]
    assert estimate_covariance((41, 4001), (2.5, 1.0)) is not None


def test_white_records_of_unequal_noise_have_their_own_variances_and_degrees() -> None:
    lengths, deviations = (101, 401), (4.0, 1.0)
    found = estimate_covariance(lengths, deviations)
    assert found is not None
    assert found.is_white
    _, residuals = unequal(lengths, deviations)
    n = np.array([100.0, 400.0])
    squares = np.array([np.sum(residuals[:100] ** 2), np.sum(residuals[100:] ** 2)])
    used = n / 500  # one parameter, which each sample determines alike
    # The variance of a record from its own degrees of freedom; n terms of it, less the share of
    # the parameter among all, which the caller's mean square has taken already.
    parts = squares / (n - used) * n * (499 / 500)
    assert found.middle[0, 0] == pytest.approx(np.sum(parts))
    degrees = np.sum(parts) ** 2 / np.sum(parts**2 / (n - used))
    assert found.compute_degrees(np.ones(1)) == pytest.approx(degrees)
    assert degrees < 0.5 * 500


def test_slow_noise_beside_white_is_as_slow_as_it_is() -> None:
    # Of neighbours the correlation is 0.45 and not 0.9: one recursion of that pole missed most.
    pole, n = 0.9, 1000
    powers = []
    for seed in draw_seeds(gate=100, night=1000):
        white, own = np.random.default_rng(seed).standard_normal((2, n))
        slow = lfilter([np.sqrt(1 - pole**2)], [1, -pole], white)
        root, _ = estimate_spectrum_root(space_residuals(np.arange(float(n)), slow + own))
        powers.append(root[0] ** 2 * 2 * (root.size - 1))
    level_of_both = (1 + pole) / (1 - pole) + 1.0
    room = bound_mean(powers, 0.1 * level_of_both)
    assert np.mean(powers) == pytest.approx(level_of_both, abs=room)


def test_a_drift_has_a_recursion_of_first_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """A long one takes what a model misses for oscillations, and says little lies between them."""
    times, random = np.arange(400.0), np.random.default_rng(0)
    wander, slow = (
        space_residuals(times, lfilter([1.0], [1.0, -pole], random.standard_normal(400)))
        for pole in (0.999, 0.9)
    )
    before = estimate_spectrum_root(wander)[0], estimate_spectrum_root(slow)[0]
    monkeypatch.setattr(sandwich, "_fit_recursion", lambda values: np.array([0.5, 0.2]))
    np.testing.assert_array_equal(estimate_spectrum_root(wander)[0], before[0])
    assert np.max(np.abs(estimate_spectrum_root(slow)[0] - before[1])) > 0
