"""Residual tests: how often they pass what is white, and what they do not let pass."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import load_model
from sysid.models.parameters import override_parameters
from sysid.residuals.autocorrelation import space_residuals
from sysid.residuals.past_outputs import count_past_output_coefficients
from sysid.residuals.residual_tests import (
    CorrelationFunction,
    ResidualTests,
    compute_correlations,
    judge_tests,
    list_residual_series,
    make_residual_series,
    run_residual_tests,
)
from sysid.simulation.problem import Problem
from tests.support.library.small_models import difference
from tests.support.profiles import draw_seeds
from tests.support.random_bounds import bound_count, bound_mean

N, STEP = 400, 0.1
TIMES = np.arange(N) * STEP
TRUE = {"K": 2.0, "T": 0.8, "L": 0.5, "y0": 0.0, "x(0)": 0.0}


def draws(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def draw_held(draw: np.random.Generator, n: int = N) -> FloatArray:
    return np.repeat(draw.choice([-1.0, 1.0], n // 5), 5)


def draw_coloured(draw: np.random.Generator, pole: float, n: int = N) -> FloatArray:
    values = draw.normal(size=n + 200)
    for k in range(1, values.size):
        values[k] += pole * values[k - 1]
    return values[200:]


def correlate_residual(
    residual: FloatArray, u: FloatArray, *, times: FloatArray = TIMES, **more: Any
) -> list[CorrelationFunction]:
    n = residual.size
    scored = more.pop("scored", np.ones(n, dtype=bool))
    channel = Channel("u", TIMES[: u.size], u, hold=more.pop("hold", "zero"))
    one = make_residual_series(0, "y", times, residual, np.zeros(n), scored, (channel,), **more)
    return compute_correlations([one])


def list_outcomes(residual: FloatArray, u: FloatArray, **more: Any) -> list[str]:
    return [one.test.outcome for one in correlate_residual(residual, u, **more)]


@pytest.mark.slow
def test_white_noise_passes_both_tests_together_in_about_95_of_100_draws() -> None:
    passed, seeds = 0, draw_seeds(gate=200, night=2000)
    for seed in seeds:
        draw = draws(seed)
        u = draw_held(draw)
        whole = judge_tests(correlate_residual(draw.normal(size=N), u), "validation")
        passed += whole.passed is True
    least, most = bound_count(len(seeds), 0.94, 0.96)
    assert least <= passed <= most


def test_white_noise_has_95_and_99_of_100_lags_inside_the_bands() -> None:
    inside = []
    for seed in draw_seeds(gate=100, night=1000):
        draw = draws(seed)
        inside.append(
            [
                (c.test.inside95, c.test.inside99)
                for c in correlate_residual(draw.normal(size=N), draw_held(draw))
            ]
        )
    for of_test in np.array(inside, dtype=float).transpose(1, 2, 0):
        for shares, told in zip(of_test, (0.95, 0.99), strict=True):
            assert np.mean(shares) == pytest.approx(told, abs=bound_mean(shares, 0.005))


def test_noise_of_first_order_is_not_white() -> None:
    for seed in range(20):
        draw = draws(seed)
        assert list_outcomes(draw_coloured(draw, 0.5), draw_held(draw))[0] == "failed"


def test_coloured_noise_that_is_independent_of_a_coloured_input_passes_that_test() -> None:
    passed, seeds = 0, draw_seeds(gate=150, night=1500)
    for seed in seeds:
        draw = draws(seed)
        residual, u = draw_coloured(draw, 0.9), draw_coloured(draw, 0.9)
        passed += list_outcomes(residual, u)[1] == "passed"
    # With bands of white noise it would be one in ten.
    assert passed >= bound_count(len(seeds), 0.94)[0]


def test_a_response_that_the_model_missed_fails_the_test_against_its_input() -> None:
    for seed in range(20):
        draw = draws(seed)
        u = draw_held(draw)
        missed = np.concatenate([np.zeros(7), u[:-7]])
        assert list_outcomes(draw.normal(size=N) + 0.5 * missed, u)[1] == "failed"


def test_the_cross_correlation_is_largest_at_the_lag_that_was_missed() -> None:
    draw = draws(5)
    u = draw.normal(size=N)
    residual = 0.2 * draw.normal(size=N) + np.concatenate([np.zeros(7), u[:-7]])
    crossed = correlate_residual(residual, u)[1]
    assert crossed.lags[np.argmax(np.abs(crossed.values))] == 7
    assert crossed.period == pytest.approx(STEP)
    assert crossed.lags[0] == -25
    assert crossed.lags[-1] == 25


def test_an_offset_of_the_model_is_a_fault_too() -> None:
    draw = draws(2)
    residual = draw.normal(size=N)
    assert list_outcomes(residual, draw_held(draw))[0] == "passed"
    assert list_outcomes(residual + 1.0, draw_held(draw))[0] == "failed"


def test_neither_test_depends_on_the_units_of_time_residual_and_input() -> None:
    draw = draws(3)
    residual, u = draw.normal(size=N), draw_held(draw)
    first = correlate_residual(residual, u)
    one = make_residual_series(
        0,
        "y",
        60 * TIMES,
        1e-3 * residual,
        np.zeros(N),
        np.ones(N, dtype=bool),
        (Channel("u", 60 * TIMES, 1e5 * u + 3e5, hold="zero"),),
    )
    for here, there in zip(first, compute_correlations([one]), strict=True):
        np.testing.assert_allclose(here.values, there.values, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(here.band95, there.band95, rtol=1e-7)


def test_missing_and_skipped_samples_take_no_part() -> None:
    draw = draws(4)
    residual, u = draw.normal(size=N), draw_held(draw)
    scored = draw.random(N) > 0.2
    scored[:30] = False
    spoilt = np.where(scored, residual, 1e6)
    for here, there in zip(
        correlate_residual(residual, u, scored=scored),
        correlate_residual(spoilt, u, scored=scored),
        strict=True,
    ):
        assert here.test == there.test
        np.testing.assert_array_equal(here.values, there.values)
    assert here.test.samples == np.count_nonzero(scored)


@pytest.mark.slow
def test_white_noise_with_gaps_or_at_irregular_times_passes_as_often() -> None:
    gaps, irregular, seeds = [], [], draw_seeds(gate=120, night=1200)
    for seed in seeds:
        draw = draws(seed)
        residual, u = draw.normal(size=N), draw_held(draw)
        gaps.append(
            judge_tests(
                correlate_residual(residual, u, scored=draw.random(N) > 0.3), "validation"
            ).passed
        )
        times = np.sort(draw.uniform(0, TIMES[-1], N // 2))
        curves = correlate_residual(residual[: N // 2], u, times=times)
        assert curves[0].period is None
        irregular.append(judge_tests(curves, "validation").passed)
    least, _ = bound_count(len(seeds), 0.94)
    assert gaps.count(True) >= least
    assert irregular.count(True) >= least


def test_a_missed_response_is_found_at_irregular_times_too() -> None:
    draw = draws(6)
    u = draw_held(draw)
    times = np.sort(draw.uniform(3, TIMES[-1], N // 2))
    missed = u[np.floor((times - 0.7) / STEP).astype(int)]
    assert list_outcomes(draw.normal(size=N // 2) + 0.7 * missed, u, times=times)[1] == "failed"


def test_residuals_that_are_rounding_are_not_tested() -> None:
    measured = 1e5 + 1e4 * np.sin(TIMES)
    rounding = 1e-11 * draws(1).normal(size=N) * measured
    one = make_residual_series(
        0,
        "y",
        TIMES,
        measured,
        measured - rounding,
        np.ones(N, dtype=bool),
        (Channel("u", TIMES, draw_held(draws(1))),),
    )
    curves = compute_correlations([one])
    assert {curve.test.outcome for curve in curves} == {"not tested"}
    assert all("rounding" in curve.test.reason for curve in curves)
    assert judge_tests(curves, "estimation").passed is None


@pytest.mark.parametrize(
    ("residual", "u", "outcome", "reason"),
    [
        (np.ones(10), np.ones(10), ["not tested", "not tested"], "10 samples are too few"),
        (np.ones(N), draw_held(draws(0)), ["failed", "not tested"], "the same everywhere"),
        (draws(0).normal(size=N), np.ones(N), ["passed", "not tested"], "the input is constant"),
        (draws(0).normal(size=N), draw_held(draws(0), 100)[:3], ["passed", "not tested"], "input"),
    ],
)
def test_what_cannot_be_tested_says_why(
    residual: FloatArray, u: FloatArray, outcome: list[str], reason: str
) -> None:
    curves = correlate_residual(residual, u, times=TIMES[: residual.size])
    assert [one.test.outcome for one in curves] == outcome
    assert reason in curves[-1].test.reason
    assert curves[-1].values.size == 0


def test_with_a_robust_loss_outliers_do_not_decide() -> None:
    draw = draws(8)
    residual, u = draw.normal(size=N), draw_held(draw)
    residual[100:102] = 300.0  # two neighbours: with squares nothing but these would be seen
    assert list_outcomes(residual, u)[0] == "failed"
    assert list_outcomes(residual, u, loss_scale=1.0)[0] == "passed"


def test_the_share_of_each_test_is_the_level_by_their_number() -> None:
    draw = draws(9)
    one = make_residual_series(
        0, "y", TIMES, draw.normal(size=N), np.zeros(N), np.ones(N, dtype=bool), ()
    )
    p = compute_correlations([one])[0].test.p
    assert p is not None
    many = [replace_experiment(one, k) for k in range(10)]
    assert compute_correlations([one], level=1.01 * p)[0].test.outcome == "failed"
    assert compute_correlations(many, level=1.01 * p)[0].test.outcome == "passed"


def replace_experiment(one: Any, number: int) -> Any:
    return one._replace(experiment=number)


def build_problem(
    draw: np.random.Generator, noise: float, **more: Any
) -> tuple[Problem, FloatArray]:
    """First order plus dead time with its true parameters, and what it gives."""
    u = draw_held(draw)
    record = Record((Channel("u", TIMES, u, hold="zero"),), (Channel("y", TIMES, np.zeros(N)),))
    true = {name: {"fixed": value} for name, value in TRUE.items()}
    bare = Problem.build(load_model("fopdt"), (record,), parameters=true, **more)
    clean = bare.predict(np.zeros((1, 0)))[0]
    measured = clean + noise * draw.normal(size=N)
    noisy = replace(record, outputs=(replace(record.outputs[0], values=measured),))
    return Problem.build(load_model("fopdt"), (noisy,), parameters=true, **more), clean


def test_the_true_model_passes_and_one_with_another_lag_fails() -> None:
    true, clean = build_problem(draws(11), 0.05)
    whole = run_residual_tests(true, clean, "estimation")
    assert isinstance(whole, ResidualTests)
    assert whole.passed is True
    assert [(one.test, one.input) for one in whole.tests] == [
        ("whiteness", None),
        ("independence", "u"),
    ]
    late = np.concatenate([np.zeros(4), clean[:-4]])
    assert run_residual_tests(true, late, "estimation").passed is False


def test_a_problem_hands_its_skipped_samples_and_its_loss_on() -> None:
    true, clean = build_problem(draws(12), 0.05, skip=40, loss=Loss("soft-l1", 0.05))
    clean = clean.copy()
    clean[:40] = 1e3
    clean[200:202] += 30.0
    whole = run_residual_tests(true, clean, "validation")
    assert whole.passed is True
    assert whole.tests[0].samples == N - 40


def test_a_true_model_without_noise_is_not_tested() -> None:
    true, clean = build_problem(draws(13), 0.0)
    assert run_residual_tests(true, clean, "estimation").passed is None


def compute_whiteness(residual: FloatArray, coefficients: int = 0) -> tuple[float, float]:
    """Statistic and degrees of freedom."""
    n = residual.size
    one = make_residual_series(
        0, "y", STEP * np.arange(n), residual, np.zeros(n), np.ones(n, dtype=bool), ()
    )
    test = compute_correlations([one._replace(coefficients=coefficients)])[0].test
    assert test.statistic is not None
    assert test.degrees is not None
    return test.statistic, test.degrees


@pytest.mark.slow
@pytest.mark.parametrize("n", [24, 40, 100])
def test_of_white_noise_the_statistic_has_the_mean_of_its_distribution(n: int) -> None:
    seeds = draw_seeds(gate=1000, night=10_000)
    statistics, degrees = np.array(
        [compute_whiteness(draws(seed).normal(size=n)) for seed in seeds]
    ).T
    ratios = statistics / degrees
    # With n²/n_k it would be 0.92.
    assert np.mean(ratios) == pytest.approx(1.0, abs=bound_mean(ratios, 0.01))


def test_one_step_ahead_the_statistic_loses_a_degree_for_each_coefficient_on_the_output() -> None:
    drawn = []
    for seed in draw_seeds(gate=300, night=3000):
        y = draw_coloured(draws(seed), 0.6)
        past = np.column_stack([np.concatenate([np.zeros(k), y[:-k]]) for k in (1, 2, 3, 4)])
        drawn.append(compute_whiteness(y - past @ np.linalg.lstsq(past, y, rcond=None)[0], 4))
    statistics, degrees = np.array(drawn).T
    assert set(degrees) == {21.0}
    assert np.mean(statistics) == pytest.approx(21.0, abs=bound_mean(statistics, 0.5))


def test_a_degree_of_freedom_is_always_left_and_records_share_the_loss() -> None:
    assert compute_whiteness(draws(1).normal(size=40), 30)[1] == 1.0
    one = make_residual_series(
        0, "y", TIMES, draws(1).normal(size=N), np.zeros(N), np.ones(N, dtype=bool), ()
    )
    pair = [one._replace(experiment=k, coefficients=4) for k in (0, 1)]
    assert [curve.test.degrees for curve in compute_correlations(pair)] == [23.0, 23.0]


def test_an_output_loses_degrees_for_its_own_coefficients_only() -> None:
    one = make_residual_series(
        0, "y", TIMES, draws(1).normal(size=N), np.zeros(N), np.ones(N, dtype=bool), ()
    )
    both = [one._replace(coefficients=4), one._replace(output="z", coefficients=2)]
    assert [curve.test.degrees for curve in compute_correlations(both)] == [21.0, 23.0]


@pytest.mark.parametrize(
    ("name", "fixed", "count"),
    [
        ("narx", (), 9),
        ("narx", ("a[y(k-1)]", "dh"), 8),
        ("fopdt", (), 1),
        ("duffing-eq16", (), 3),
        ("tube-second-order", (), 2),
        ("exponential", (), 0),
        ("emps", (), 3),
    ],
)
def test_coefficients_on_past_outputs_are_those_that_multiply_a_state(
    name: str, fixed: tuple[str, ...], count: int
) -> None:
    model = load_model(name)
    given = {one: {"fixed": 1.0} for one in fixed}
    found = count_past_output_coefficients(model, override_parameters(model.parameters, given))
    assert found == {"y": count}


def test_a_parameter_inside_a_function_of_a_state_is_a_coefficient() -> None:
    model = difference({"x": "sin(x(k - 1) + b) + c"}, "x")
    assert count_past_output_coefficients(model, model.parameters) == {"y": 1}


def test_only_predictions_one_step_ahead_of_the_estimation_data_lose_degrees() -> None:
    draw = draws(14)
    record = Record(
        (Channel("u", TIMES, draw_held(draw), hold="zero"),),
        (Channel("y", TIMES, draw.normal(size=N)),),
    )
    for prediction, data, degrees in (
        ("simulation", "estimation", 25.0),
        ("one-step", "validation", 25.0),
        ("one-step", "estimation", 24.0),
    ):
        one = Problem.build(load_model("fopdt"), (record,), prediction=prediction)  # type: ignore[arg-type]
        tests = run_residual_tests(one, np.zeros(N), data).tests  # type: ignore[arg-type]
        assert tests[0].degrees == degrees


@pytest.mark.parametrize("kind", [np.int64, np.float32, np.float64])
def test_one_input_after_another_is_told_apart_whatever_its_numbers_are(kind: type) -> None:
    draw = draws(7)
    residual, inputs = draw.normal(size=N), [draw_held(draw), draw_held(draw)]
    first, second = (correlate_residual(residual, u)[1].values for u in inputs)
    assert not np.array_equal(first, second)
    again = [correlate_residual(residual, u.astype(kind))[1].values for u in inputs]
    assert np.array_equal(again, [first, second])


@pytest.mark.parametrize(("faulty", "outcome"), [("first", "passed"), ("last", "failed")])
def test_of_a_long_record_the_last_20_000_samples_are_tested(faulty: str, outcome: str) -> None:
    n = 23_000
    draw = draws(15)
    residual, u = draw.normal(size=n), draw_held(draw, n)
    span = slice(0, 3000) if faulty == "first" else slice(n - 3000, n)
    residual[span] += np.concatenate([np.zeros(7), u[span][:-7]])  # a missed response
    times = STEP * np.arange(n)
    channel = Channel("u", times, u, hold="zero")
    everything = np.ones(n, dtype=bool)
    series = make_residual_series(0, "y", times, residual, np.zeros(n), everything, (channel,))
    tests = [curve.test for curve in compute_correlations([series])]
    assert [test.samples for test in tests] == [20_000, 20_000]
    assert tests[1].outcome == outcome
    # The size that tells rounding is that of the tested part.
    assert series.size == np.max(np.abs(residual[-20_000:]))


def test_outputs_of_other_weights_meet_a_robust_loss_with_their_weights() -> None:
    model = difference(
        {"x": "c*x(k-1) + b*u(k-1)"}, "x", outputs={"y": "x", "z": "2*x"}, initial={"x": 0}
    )
    draw = draws(16)
    record = Record(
        (Channel("u", TIMES, draw_held(draw)),),
        tuple(Channel(name, TIMES, draw.normal(size=N)) for name in ("y", "z")),
    )
    scale, weights = 0.7, {"y": 4.0, "z": 0.25}
    fixed = {"c": {"fixed": 0.5}, "b": {"fixed": 1.0}, "L": {"fixed": 0.0}}
    one = Problem.build(
        model, (record,), parameters=fixed, weights=weights, loss=Loss("soft-l1", scale)
    )
    simulated = draw.normal(size=2 * N)
    for series, model_output in zip(
        list_residual_series(one, simulated),
        one.split_by_output(simulated)[0].values(),
        strict=True,
    ):
        measured = next(item.values for item in record.outputs if item.name == series.output)
        error = weights[series.output] * (measured - model_output)
        np.testing.assert_allclose(series.residual, error / np.sqrt(1 + (error / scale) ** 2))
        assert series.size == np.max(np.abs(weights[series.output] * measured))


@pytest.mark.parametrize(("share", "is_regular"), [(0.04, True), (0.06, False), (0.4, False)])
def test_samples_count_as_regular_up_to_5_percent_of_a_period_off_their_place(
    share: float, is_regular: bool
) -> None:
    times = TIMES.copy()
    times[[50, 171]] += share * STEP
    assert space_residuals(times, np.ones(N)).is_regular is is_regular
    crossed = correlate_residual(draws(17).normal(size=N), draw_held(draws(17)), times=times)
    assert (crossed[0].period is not None) is is_regular


def test_the_last_value_of_a_held_input_holds_for_a_period() -> None:
    draw = draws(18)
    coarse = draw.choice([-1.0, 1.0], N // 2)
    fine = Channel("u", TIMES, np.repeat(coarse, 2), hold="zero")
    sparse = Channel("u", TIMES[::2], coarse, hold="zero")
    assert sparse.times[-1] < TIMES[-1]
    residual = draw.normal(size=N)
    residual[-1] = 30.0  # if this sample is left out, every correlation changes
    both = [
        make_residual_series(0, "y", TIMES, residual, np.zeros(N), np.ones(N, dtype=bool), (one,))
        for one in (fine, sparse)
    ]
    first, second = (compute_correlations([series])[1] for series in both)
    np.testing.assert_allclose(second.values, first.values, atol=1e-12)
