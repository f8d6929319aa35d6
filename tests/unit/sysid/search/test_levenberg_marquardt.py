"""Levenberg–Marquardt steps against dense linear algebra."""

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.search.levenberg_marquardt import (
    compute_inner_product,
    factor_damped,
    form_normal_equations,
    step_aside,
    write_damped_step,
    write_spread_point,
)

POINT = np.array([0.3, 0.6, 0.45])


def draw(seed: int = 1, n: int = 43) -> tuple[FloatArray, FloatArray]:
    """Residuals (n,) and slopes (3, n)."""
    random = np.random.default_rng(seed)
    return random.standard_normal(n), random.standard_normal((3, n)) * [[1.0], [3.0], [0.2]]


@pytest.mark.parametrize("scale", [0.0, 0.5])
@pytest.mark.parametrize("n", [3, 43])  # fewer than four, and no multiple of four
def test_normal_equations_are_those_of_weighted_residuals(scale: float, n: int) -> None:
    error, columns = draw(n=n)
    weight = 1.0 / np.sqrt(1.0 + (error / scale) ** 2) if scale else np.ones(n)
    matrix, gradient = form_normal_equations(error, columns, scale)
    np.testing.assert_allclose(gradient, columns @ (weight * error), rtol=1e-12)
    np.testing.assert_allclose(matrix, np.tril((columns * weight) @ columns.T), rtol=1e-12)


@pytest.mark.parametrize("n", [0, 3, 4, 43])
def test_an_inner_product_has_the_bits_of_four_running_sums(n: int) -> None:
    first, (second, *_) = draw(n=n + 5)
    sums = [0.0] * 4
    for m in range(n // 4 * 4):
        sums[m % 4] += first[m] * second[m]
    for m in range(n // 4 * 4, n):
        sums[0] += first[m] * second[m]
    expected = (sums[0] + sums[1]) + (sums[2] + sums[3])
    assert compute_inner_product(first, second, n) == expected


def test_slopes_beyond_the_residuals_do_not_count() -> None:
    error, columns = draw()
    for whole, cut in zip(
        form_normal_equations(error[:20].copy(), columns, 0.5),
        form_normal_equations(error[:20].copy(), columns[:, :20].copy(), 0.5),
        strict=True,
    ):
        assert np.array_equal(whole, cut)


@pytest.mark.parametrize("damping", [0.0, 0.01, 10.0])
def test_a_damped_step_solves_the_damped_equations_and_promises_its_linear_gain(
    damping: float,
) -> None:
    error, columns = draw()
    matrix, gradient = form_normal_equations(0.01 * error, columns, 0.0)
    whole = matrix + np.tril(matrix, -1).T
    step = -np.linalg.solve(whole + damping * np.diag(np.diag(whole)), gradient)
    place = np.empty(3)
    promised = write_damped_step(matrix, gradient, POINT, damping, place)
    np.testing.assert_allclose(place, POINT + step, rtol=1e-9)
    assert promised == pytest.approx(-gradient @ step)


@pytest.mark.parametrize(("end", "held"), [(0.0, 1.0), (1.0, -1.0)])
def test_a_parameter_at_its_bound_stays_if_the_loss_falls_outwards_only(
    end: float, held: float
) -> None:
    error, columns = draw()
    matrix, gradient = form_normal_equations(0.01 * error, columns, 0.0)
    point = np.array([0.3, end, 0.45])
    whole = matrix + np.tril(matrix, -1).T
    for sign in (held, -held):
        gradient[1] = sign * abs(gradient[1])
        place = np.empty(3)
        write_damped_step(matrix, gradient, point, 0.0, place)
        if sign == held:
            others = np.ix_([0, 2], [0, 2])
            step = np.insert(-np.linalg.solve(whole[others], gradient[[0, 2]]), 1, 0.0)
        else:
            step = -np.linalg.solve(whole, gradient)
        np.testing.assert_allclose(place, np.clip(point + step, 0.0, 1.0), rtol=1e-9)
        assert (place[1] == end) == (sign == held)


def test_a_parameter_that_others_replace_stays() -> None:
    error, columns = draw()
    columns[2] = 2.0 * columns[0]
    matrix, gradient = form_normal_equations(0.01 * error, columns, 0.0)
    place = np.empty(3)
    write_damped_step(matrix, gradient, POINT, 0.0, place)
    gained = np.linalg.lstsq(columns[:2].T, 0.01 * error, rcond=None)[0]
    np.testing.assert_allclose(place, POINT - [*gained, 0.0], rtol=1e-6)


def test_spread_places_have_the_covariance_of_the_inverse() -> None:
    _, columns = draw()
    matrix, gradient = form_normal_equations(np.zeros(43), 20.0 * columns, 0.0)
    factor = factor_damped(matrix, gradient, POINT, 0.0)
    moves, place = [], np.empty(3)
    for deviation in np.eye(3):
        write_spread_point(factor, POINT, deviation.copy(), place)
        moves.append(place - POINT)
    expected = np.linalg.inv(400.0 * columns @ columns.T)
    np.testing.assert_allclose(np.array(moves).T @ np.array(moves), expected, rtol=1e-9)


def test_neighbours_differ_in_one_parameter_away_from_the_nearer_bound() -> None:
    places, steps = step_aside(np.array([0.0, 1.0, 0.2]), 0.01)
    assert steps.tolist() == [0.01, -0.01, 0.01]
    np.testing.assert_allclose(places - places[0], np.vstack([np.zeros(3), np.diag(steps)]))
