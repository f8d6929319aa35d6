"""Generalised least squares under first-order noise, against its closed form and repetition."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm, Loss, Stop
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification import deadline
from sysid.identification.conclude import conclude_run
from sysid.identification.identify import identify
from sysid.identification.run import advance_run, begin_run
from sysid.models.catalogue.load import load_model
from sysid.noise_models.generalised_least_squares import fit_generalised_least_squares
from sysid.residuals.series import make_whitening
from sysid.residuals.whitening import Whitening, compute_ar1_coefficient
from sysid.results.identification import Identification
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.profile_likelihood import compute_profile
from tests.support.library import search_problems
from tests.support.profiles import PROFILE, draw_seeds
from tests.support.random_bounds import bound_count, bound_mean
from tests.unit.sysid.residuals.test_coloured import colour_noise

GAIN = {
    "name": "gain",
    "form": "difference",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {"g": {"lower": -10, "upper": 10}, "m": {"lower": -10, "upper": 10}},
    "equations": {"x": "g*u + m"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}
STEP, N, POLE = 0.1, 400, 0.95
AR1 = Loss(noise_model="ar1")
SMALL = GeneticAlgorithm(population=24, generations=20)


def make_record(seed: int, pole: float = POLE, kept: FloatArray | None = None) -> Record:
    """y = 2 u + 1 + noise of sd 0.2, with a u that is white."""
    times = STEP * np.arange(N)
    u = np.random.default_rng([seed, 1]).choice([-1.0, 1.0], N)
    y = 2.0 * u + 1.0 + 0.2 * colour_noise(N, pole, seed)
    here = np.ones(N, dtype=bool) if kept is None else kept.astype(bool)
    return Record((Channel("u", times, u),), (Channel("y", times[here], y[here]),))


def build_problem(*records: Record, loss: Loss = AR1) -> Problem:
    return Problem.build(load_model(GAIN), records, loss=loss, skip=1)


def squares(problem: Problem) -> FloatArray:
    end = refine_candidates(problem, [np.zeros(len(problem.free_parameters))])[0]
    assert end is not None
    return end.theta


def fit_regression(problem: Problem, white: Whitening) -> FloatArray:
    """The generalised least-squares estimate of this linear model, in closed form."""
    base = problem.predict(np.zeros((1, 2)))[0]
    columns = (problem.predict(np.eye(2)) - base).T
    scored = problem.evaluator.weight > 0
    seen, y = white.whiten(columns[scored].T).T, white.whiten(problem.evaluator.measured[scored])
    return np.asarray(np.linalg.lstsq(seen, y, rcond=None)[0])


def test_whitening_takes_the_correlation_out_of_first_order_noise_at_any_times() -> None:
    times = np.cumsum(np.random.default_rng(1).exponential(1.0, 12))
    noise = np.exp(-np.abs(times[:, None] - times) / 2.5)
    white = Whitening(compute_ar1_coefficient(times, 2.5))
    of = white.whiten(np.eye(12)).T
    np.testing.assert_allclose(of @ noise @ of.T, np.eye(12), atol=1e-12)
    assert white.log_determinant == pytest.approx(np.linalg.slogdet(noise)[1])


def test_estimates_are_those_of_generalised_least_squares_in_closed_form() -> None:
    problem = build_problem(make_record(1), make_record(2))
    found = fit_generalised_least_squares(problem, squares(problem), np.zeros((2, 2)), 1)
    assert found.is_complete
    white = make_whitening(problem, found.correlation_times)
    np.testing.assert_allclose(found.theta, fit_regression(problem, white), rtol=1e-5)


def test_the_correlation_time_is_found_with_and_without_missing_samples() -> None:
    kept = np.random.default_rng(5).random(N) < 0.8
    kept[0] = True
    true = -STEP / np.log(0.8)
    for chosen in (None, kept):
        found = []
        for seed in draw_seeds(gate=20, night=200):
            problem = build_problem(make_record(seed, 0.8, chosen))
            end = fit_generalised_least_squares(problem, squares(problem), np.zeros((2, 2)), 1)
            found.append(end.correlation_times["y"])
        assert np.mean(found) == pytest.approx(true, rel=0.15)


def test_the_correlation_time_counts_the_noise_that_parameters_absorb() -> None:
    n, pole = 200, 0.9
    times = STEP * np.arange(n)
    u = np.sin(2 * np.pi * np.arange(n) / n)  # as slow as the noise
    found = []
    for seed in draw_seeds(gate=40, night=200):
        y = 2.0 * u + 1.0 + 0.2 * colour_noise(n, pole, seed)
        problem = build_problem(Record((Channel("u", times, u),), (Channel("y", times, y),)))
        end = fit_generalised_least_squares(problem, squares(problem), np.zeros((2, 2)), 1)
        found.append(end.correlation_times["y"])
    true = -STEP / np.log(pole)
    assert np.mean(found) == pytest.approx(true, abs=bound_mean(found, 0.15 * true))


def test_a_long_record_says_more_of_the_correlation_time_than_a_short_one() -> None:
    short = (np.arange(N) < 60).astype(np.float64)
    records = make_record(1), make_record(2, 0.5, short)
    together = build_problem(*records)
    found = fit_generalised_least_squares(together, squares(together), np.zeros((2, 2)), 1)
    alone = []
    for one in records:
        problem = build_problem(one)
        end = fit_generalised_least_squares(problem, squares(problem), np.zeros((2, 2)), 1)
        alone.append(end.correlation_times["y"])
    assert alone[0] > 5 * alone[1] > 0
    expected = (N * alone[0] + 60 * alone[1]) / (N + 60)
    assert found.correlation_times["y"] == pytest.approx(expected, rel=0.2)


@pytest.mark.parametrize("unit", [2.0**40, 2.0**-40])
def test_estimates_under_slow_noise_do_not_depend_on_the_inputs_unit(unit: float) -> None:
    data = make_record(4)
    (u,) = data.inputs
    other = replace(data, inputs=(replace(u, values=u.values * unit),))
    bounds = {"g": {"lower": -10.0 / unit, "upper": 10.0 / unit}}
    found = identify(load_model(GAIN), [data], SMALL, seed=1, loss=AR1, skip=1)
    same = identify(load_model(GAIN), [other], SMALL, seed=1, loss=AR1, skip=1, parameters=bounds)
    g, m = (one.value for one in found.parameters)
    assert tuple(one.value for one in same.parameters) == (g / unit, m)
    assert same.correlation_times == found.correlation_times


def test_under_slow_noise_a_fast_input_tells_more_than_squares_make_of_it() -> None:
    errors = []
    for seed in draw_seeds(gate=20, night=200):
        problem = build_problem(make_record(seed))
        plain = squares(problem)
        found = fit_generalised_least_squares(problem, plain, np.zeros((2, 2)), 1)
        errors.append([plain[0] - 2.0, found.theta[0] - 2.0])
    plain_size, size = np.sqrt(np.mean(np.square(errors), axis=0))
    assert size < 0.5 * plain_size


def test_intervals_under_first_order_noise_hold_the_truth() -> None:
    held, deviations, colours = [], [], []
    for seed in draw_seeds(gate=12, night=200):
        found = identify(
            load_model(GAIN), make_record(seed, 0.9), SMALL, loss=AR1, skip=1, seed=seed
        )
        assert found.noise_sd is not None
        colours.append(found.noise_colour)
        deviations.append(found.noise_sd)
        for one, true in zip(found.parameters, (2.0, 1.0), strict=True):
            assert one.interval95 is not None
            held.append(one.interval95[0] <= true <= one.interval95[1])
    others = sum(colour != "first-order" for colour in colours)
    assert others <= (bound_count(len(colours), 0.02)[1] if PROFILE == "night" else 0)
    assert np.mean(deviations) == pytest.approx(0.2, abs=bound_mean(deviations, 0.01))
    assert sum(held) >= bound_count(len(held), 0.93)[0]


def test_the_likelihood_tells_that_the_noise_model_is_the_better_one() -> None:
    plain, found = (
        identify(load_model(GAIN), make_record(3), SMALL, loss=loss, skip=1)
        for loss in (Loss(noise_model="white"), AR1)
    )
    assert plain.criteria is not None
    assert found.criteria is not None
    assert found.criteria.bic < plain.criteria.bic - 100.0
    assert found.rms > plain.rms
    assert any("first-order noise" in text for text in found.warnings)


def test_residuals_are_tested_without_what_the_noise_model_explains() -> None:
    plain, found = (
        identify(load_model(GAIN), make_record(3), SMALL, loss=loss, skip=1)
        for loss in (Loss(noise_model="white"), AR1)
    )
    assert plain.residual_tests is not None
    assert found.residual_tests is not None
    assert plain.residual_tests.passed is False
    assert found.residual_tests.passed is True


def test_white_residuals_leave_everything_as_it_is() -> None:
    plain, found = (
        identify(load_model(GAIN), make_record(3, 0.0), SMALL, loss=loss, skip=1)
        for loss in (Loss(), AR1)
    )
    assert [replace(one) for one in found.parameters] == list(plain.parameters)
    assert not found.correlation_times
    assert any("consistent with white noise" in text for text in found.warnings)


def test_of_a_rough_loss_intervals_hold_the_minima_that_the_noise_does_not_rule_out() -> None:
    data = search_problems.record(
        search_problems.clean("coulomb-eq16") + 0.02 * colour_noise(300, 0.9, 2)
    )
    problem = Problem.build(load_model("coulomb-eq16"), [data], loss=AR1)
    settings = GeneticAlgorithm(stop=Stop(evaluations=30_000))
    found = conclude_run(
        problem, settings, advance_run(problem, settings, begin_run(problem, settings, 1))
    )
    assert found.correlation_times["y"] > 0
    theta = np.array([one.value for one in found.parameters])
    white = make_whitening(problem, found.correlation_times)
    wider = []
    for one, alone in zip(
        found.parameters, analyse_estimate(problem, theta, None, white).estimates, strict=True
    ):
        assert one.interval95 is not None
        assert alone.interval95 is not None
        (low, high), (lower, upper) = alone.interval95, one.interval95
        assert lower <= low < high <= upper
        wider.append((upper - lower) / (high - low))
    assert max(wider) > 1.01


def test_a_budget_that_does_not_suffice_is_told_and_kept() -> None:
    settings = replace(SMALL, stop=Stop(evaluations=130, settled=None))
    found = identify(load_model(GAIN), make_record(3), settings, loss=AR1, skip=1)
    assert found.evaluations <= 130
    assert any("not estimated completely" in text for text in found.warnings)


def test_a_noise_model_gets_the_time_that_is_left_and_no_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = build_problem(make_record(3))
    timed = replace(SMALL, stop=Stop(seconds=100.0, settled=None))
    state = advance_run(problem, timed, begin_run(problem, timed, 1))
    whole = conclude_run(problem, timed, replace(state, seconds=1.0))
    monkeypatch.setattr(deadline, "_STEPS_AFTER_DEADLINE", 30 * problem.n_steps)
    late = conclude_run(problem, timed, replace(state, seconds=100.0))
    soon = conclude_run(problem, timed, replace(state, seconds=99.0))  # time for a hundredth more
    said = "not estimated completely"
    assert [any(said in one for one in found.warnings) for found in (whole, soon, late)] == [
        False,
        True,
        True,
    ]
    assert late.evaluations <= whole.evaluations - 50
    assert conclude_run(problem, timed, replace(state, seconds=1.0)).parameters == whole.parameters


def test_what_a_noise_model_cannot_do_is_refused() -> None:
    with pytest.raises(InvalidSettings, match="need the loss 'squares'"):
        Loss("soft-l1", 0.1, "ar1")
    with pytest.raises(InvalidSettings, match="auto, white, ar1, plant, load or drift"):
        Loss(noise_model="pink")  # type: ignore[arg-type]
    with pytest.raises(InvalidSettings, match="one-step predictions already contain the noise"):
        Problem.build(load_model(GAIN), [make_record(1)], loss=AR1, prediction="one-step")
    with pytest.raises(InvalidSettings, match="profiles are of plain squares"):
        compute_profile(build_problem(make_record(1)), np.array([2.0, 1.0]), "g")


def test_every_output_has_a_noise_of_its_own_and_a_kept_part_is_judged() -> None:
    both = {**GAIN, "outputs": {"y": "x", "z": "2*x"}}
    times = STEP * np.arange(N)
    u = np.random.default_rng(1).choice([-1.0, 1.0], N)
    y = 2.0 * u + 1.0
    slow, white = colour_noise(N, 0.95, 1), colour_noise(N, 0.0, 2)
    data = Record(
        (Channel("u", times, u),),
        (Channel("y", times, y + 0.2 * slow), Channel("z", times, 2.0 * y + 0.2 * white)),
    )
    found = identify(load_model(both), data, SMALL, loss=AR1, skip=1, validation_fraction=0.3)
    assert set(found.correlation_times) == {"y"}
    assert found.correlation_times["y"] > 3 * STEP
    assert found.rms_validation is not None
    assert found.residual_tests is not None
    assert {one.output for one in found.residual_tests.tests} == {"y", "z"}


def identify_line(u: FloatArray, y: FloatArray) -> Identification:
    times = STEP * np.arange(u.size)
    one = Record((Channel("u", times, u, hold="first"),), (Channel("y", times, y),))
    return identify(load_model(GAIN), one, SMALL, skip=1)


def test_slow_noise_is_taken_into_account_without_a_hedge() -> None:
    u = np.random.default_rng([3, 1]).choice([-1.0, 1.0], N)
    slow = identify_line(u, 2.0 * u + 1.0 + 0.2 * colour_noise(N, POLE, 3))
    assert (slow.noise_model, slow.verdict.text) == ("ar1", "trustworthy")
    assert any("assume first-order noise" in text for text in slow.warnings)
    white = identify_line(u, 2.0 * u + 1.0 + 0.2 * colour_noise(N, 0.0, 3))
    assert (white.noise_model, white.verdict.text) == ("white", "trustworthy")
    assert white.warnings == ()


def test_dynamics_are_no_noise() -> None:
    u = np.repeat(np.random.default_rng([3, 2]).choice([-1.0, 1.0], N // 4), 4)
    y, pole = np.zeros(N), 0.8
    for k in range(1, N):
        y[k] = pole * y[k - 1] + (1.0 - pole) * 2.0 * u[k - 1]
    found = identify_line(u, y + 0.01 * colour_noise(N, 0.0, 3))
    assert found.noise_model == "white"
    assert found.verdict.trust == "not trustworthy"
