"""Bounded least squares: the library's answer, found in batches."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from sysid.least_squares import TRIED, Loss, solve

TIMES = np.linspace(0.0, 4.0, 60)


def decay(places):
    """A sum of two decays whose amplitudes and rates are places in [0, 1]."""
    a, b, p, q = (places[:, i, None] for i in range(4))
    return 2 * a * np.exp(-4 * p * TIMES) + 2 * b * np.exp(-0.5 * q * TIMES)


def residuals_of(measured):
    return lambda places: decay(places) - measured


def jacobian_of(residuals):
    def jacobian(place, error):
        steps = np.where(place < 0.5, 1e-7, -1e-7)
        return ((residuals(place + np.diag(steps)) - error) / steps[:, None]).T

    return jacobian


def found(measured, start, scale=0.0, steps=100):
    residuals = residuals_of(measured)
    return solve(residuals, jacobian_of(residuals), np.array(start), Loss(scale), steps=steps)


def library(measured, start, scale=0.0):
    one = residuals_of(measured)
    return least_squares(
        lambda place: one(place[None])[0], start, bounds=(0, 1), xtol=1e-14, ftol=1e-14,
        gtol=1e-14, loss="soft_l1" if scale else "linear", f_scale=scale or 1.0, max_nfev=2000,
    ).x  # fmt: skip


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", [0.0, 0.02])
def test_the_optimum_is_that_of_the_library(seed, scale):
    rng = np.random.default_rng(seed)
    measured = decay(np.array([[0.4, 0.3, 0.6, 0.4]]))[0] + rng.normal(0, 0.01, TIMES.size)
    measured[::15] += 0.5 if scale else 0.0  # outliers are what the robust loss is for
    start = [0.5, 0.4, 0.5, 0.5]
    ended = found(measured, start, scale)
    assert ended.is_converged
    np.testing.assert_allclose(ended.place, library(measured, start, scale), atol=2e-4)


def test_a_place_whose_optimum_lies_outside_ends_at_the_bound_and_the_others_at_their_best():
    measured = decay(np.array([[0.4, 1.3, 0.6, 0.4]]))[0]
    ended = found(measured, [0.5, 0.5, 0.5, 0.5])
    assert ended.place[1] == 1.0
    np.testing.assert_allclose(ended.place, library(measured, [0.5] * 4), atol=1e-3)


def test_a_place_without_effect_stays_where_it_is():
    residuals = lambda places: places[:, :1] * TIMES - 0.3 * TIMES  # noqa: E731
    ended = solve(residuals, jacobian_of(residuals), np.array([0.9, 0.7]), Loss(), steps=20)
    np.testing.assert_allclose(ended.place, [0.3, 0.7], atol=1e-9)


def test_a_step_into_a_region_that_diverges_is_not_taken():
    def residuals(places):
        x = places[:, 0, None] * np.ones(5)
        return np.where(x < 0.3, np.inf, x - 0.31)

    ended = solve(residuals, jacobian_of(residuals), np.array([0.9]), Loss(), steps=50)
    assert ended.place[0] == pytest.approx(0.31, abs=1e-6)


def test_the_steps_allowed_bound_the_simulations():
    counted = 0
    inner = residuals_of(decay(np.array([[0.4, 0.3, 0.6, 0.4]]))[0])

    def residuals(places):
        nonlocal counted
        counted += len(places)
        return inner(places)

    solve(residuals, jacobian_of(residuals), np.full(4, 0.9), Loss(), steps=3)
    assert counted <= 1 + 3 * (4 + TRIED)


def test_the_slopes_of_a_place_are_taken_once_however_often_steps_from_it_are_refused():
    places = []

    def residuals(tried):
        first = tried[:, :1]
        return np.where(first == 0.5, first * TIMES, 1e3 * np.ones(TIMES.size))

    def jacobian(place, error):
        places.append(place.tobytes())
        return TIMES[:, None]

    ended = solve(residuals, jacobian, np.array([0.5]), Loss(), steps=20)
    assert ended.place[0] == 0.5
    assert len(places) == len(set(places)) == 1


@pytest.mark.parametrize("start", [1.0, 1.0 - 1e-15])
def test_a_step_that_a_bound_cuts_off_promises_only_what_is_left_of_it(start):
    batches = []

    def residuals(places):
        batches.append(len(places))
        return places[:, :1] * np.ones(5) - 3.0

    ended = solve(residuals, lambda *_: np.ones((5, 1)), np.array([start]), Loss(), steps=20)
    assert ended.is_converged
    assert ended.place[0] == start
    assert batches == [1]
