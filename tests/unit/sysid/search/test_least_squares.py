"""Bounded least squares: the library's answer, found in batches."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import load_model
from sysid.search.least_squares import (
    N_TRIED,
    LeastSquaresSolution,
    ScoredSamples,
    solve_least_squares,
)
from sysid.simulation.problem import Problem

TIMES = np.linspace(0.0, 4.0, 60)
DECAY = "2*a*exp(-4*p*t) + 2*b*exp(-0.5*q*t)"


def build_samples(
    text: str, names: str, measured: FloatArray, times: FloatArray = TIMES
) -> ScoredSamples:
    """Residuals of an expression of time, whose parameters are places in [0, 1]."""
    document = {
        "name": "test",
        "form": "differential",
        "states": {"x": "1"},
        "parameters": {name: {"lower": 0, "upper": 1} for name in names},
        "equations": {"x": "0"},
        "initial": {"x": 0},
        "outputs": {"y": f"x + {text}"},
    }
    problem = Problem.build(load_model(document), [Record((), (Channel("y", times, measured),))])
    return ScoredSamples(problem.evaluator, problem.scored_rows, np.ones(measured.size))


def make_decay(place: FloatArray) -> FloatArray:
    """A sum of two decays."""
    a, b, p, q = place
    return np.asarray(2 * a * np.exp(-4 * p * TIMES) + 2 * b * np.exp(-0.5 * q * TIMES))


def solve_from(
    subject: ScoredSamples,
    start: list[float],
    scale: float = 0.0,
    steps: int = 100,
    at_once: int = 100,
) -> LeastSquaresSolution:
    return solve_least_squares(subject, np.array(start), scale, steps=steps, at_once=at_once)


def library(measured: FloatArray, start: list[float], scale: float = 0.0) -> FloatArray:
    return np.asarray(
        least_squares(
            lambda place: make_decay(place) - measured,
            start,
            bounds=(0, 1),
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
            loss="soft_l1" if scale else "linear",
            f_scale=scale or 1.0,
            max_nfev=2000,
        ).x
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", [0.0, 0.02])
def test_the_optimum_is_that_of_the_library(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    measured = make_decay(np.array([0.4, 0.3, 0.6, 0.4])) + rng.normal(0, 0.01, TIMES.size)
    measured[::15] += 0.5 if scale else 0.0  # outliers are what the robust loss is for
    start = [0.5, 0.4, 0.5, 0.5]
    ended = solve_from(build_samples(DECAY, "abpq", measured), start, scale)
    assert ended.is_converged
    np.testing.assert_allclose(ended.point, library(measured, start, scale), atol=2e-4)


def test_a_place_whose_optimum_lies_outside_ends_at_the_bound_and_the_others_at_their_best() -> (
    None
):
    measured = make_decay(np.array([0.4, 1.3, 0.6, 0.4]))
    ended = solve_from(build_samples(DECAY, "abpq", measured), [0.5] * 4)
    assert ended.point[1] == 1.0
    np.testing.assert_allclose(ended.point, library(measured, [0.5] * 4), atol=1e-3)


def test_a_place_without_effect_stays_where_it_is() -> None:
    ended = solve_from(build_samples("a*t + 0*b", "ab", 0.3 * TIMES), [0.9, 0.7], steps=20)
    np.testing.assert_allclose(ended.point, [0.3, 0.7], atol=1e-9)


def test_a_step_into_a_region_that_diverges_is_not_taken() -> None:
    subject = build_samples("where(a < 0.3, 1/(0*a), a)", "a", np.full(60, 0.31))
    ended = solve_from(subject, [0.9], steps=50)
    assert ended.point[0] == pytest.approx(0.31, abs=1e-6)


def test_the_steps_allowed_bound_the_simulations() -> None:
    subject = build_samples(DECAY, "abpq", make_decay(np.array([0.4, 0.3, 0.6, 0.4])))
    ended = solve_from(subject, [0.9] * 4, steps=3)
    assert not ended.is_converged
    assert ended.evaluations == 1 + 3 * (4 + N_TRIED)


def test_the_slopes_of_a_place_are_taken_once_however_often_steps_from_it_are_refused() -> None:
    subject = build_samples("where(a == 0.5, 0.5*t, 1000)", "a", 0.4 * TIMES)
    for steps in (1, 2, 3):
        ended = solve_from(subject, [0.5], steps=steps)
        assert ended.point[0] == 0.5
        assert ended.evaluations == 1 + 1 + steps * N_TRIED


@pytest.mark.parametrize("start", [1.0, 1.0 - 1e-15])
def test_a_step_that_a_bound_cuts_off_promises_only_what_is_left_of_it(start: float) -> None:
    ended = solve_from(build_samples("a", "a", np.full(60, 3.0)), [start], steps=20)
    assert ended.is_converged
    assert ended.point[0] == start
    assert ended.evaluations == 1 + 1


@pytest.mark.parametrize("scale", [0.0, 0.02])
def test_how_a_search_is_cut_into_calls_changes_no_bit_of_it(scale: float) -> None:
    rng = np.random.default_rng(7)
    measured = make_decay(np.array([0.4, 0.3, 0.6, 0.4])) + rng.normal(0, 0.01, TIMES.size)
    subject = build_samples(DECAY, "abpq", measured)
    for steps in (5, 100):
        whole = solve_from(subject, [0.9, 0.1, 0.9, 0.1], scale, steps)
        for at_once in (1, 3):
            cut = solve_from(subject, [0.9, 0.1, 0.9, 0.1], scale, steps, at_once)
            assert cut.point.tobytes() == whole.point.tobytes()
            assert (cut.evaluations, cut.is_converged) == (whole.evaluations, whole.is_converged)
