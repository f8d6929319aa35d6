"""Laws of trends: exact laws are recovered, units do not matter, intervals cover what they say."""

from math import inf, log
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sysid.trends.laws import TrendLaw, fit_line, fit_power
from sysid.trends.trend import (
    Drift,
    TrendEstimate,
    TrendPoint,
    compute_drift,
    compute_drift_limit,
    compute_half_width,
    compute_law_drifts,
    fit_trend,
    pool_estimates,
    predict_estimates,
)
from tests.support.profiles import draw_seeds, scale_examples
from tests.support.random_bounds import bound_count

X = np.array([5.0, 10.0, 20.0, 40.0, 80.0])
NUMBER = st.floats(-10, 10).filter(lambda v: v == 0 or abs(v) > 1e-3)
SCALE = st.floats(1e-6, 1e6)


def make_prediction(law: TrendLaw, x: np.ndarray, stderr: np.ndarray, at: float) -> TrendPoint:
    return predict_estimates(law, x, stderr, np.array([at]))[0]


def drift_from_law(
    new: TrendEstimate,
    law: TrendLaw,
    x: np.ndarray,
    stderr: np.ndarray,
    at: float,
    comparisons: int = 1,
) -> Drift:
    return compute_law_drifts([new], law, x, stderr, np.array([at]), comparisons)[0]


def draw_coefficients(law: TrendLaw) -> dict[str, tuple[float, float]]:
    return {name: (value, error) for name, value, error in law.coefficients}


def make_noisy(seed: int, n: int = 9) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    draw = np.random.default_rng(seed)
    x = np.sort(draw.uniform(1.0, 50.0, n))
    stderr = draw.uniform(0.5, 2.0, n)
    return x, 3.0 * x**0.8 + stderr * draw.normal(size=n), stderr


@settings(max_examples=scale_examples(50))
@given(NUMBER, NUMBER)
def test_an_exact_line_is_recovered_and_chosen(a: float, b: float) -> None:
    found = fit_trend(X, a + b * X, np.full(5, 0.1), [30.0])
    assert found.best_law is not None
    assert found.best_law.kind == "line"
    told = draw_coefficients(found.best_law)
    assert told["a"][0] == pytest.approx(a, abs=1e-12 * (abs(a) + 80 * abs(b)))
    assert told["b"][0] == pytest.approx(b, abs=1e-12 * (abs(a) + abs(b)))
    assert found.predictions[0].value == pytest.approx(a + 30 * b, abs=1e-11)
    assert not any(one.is_outlier for one in found.influences)


@settings(max_examples=scale_examples(50))
@given(NUMBER.filter(bool), st.floats(-3, 3).filter(lambda b: min(abs(b), abs(b - 1)) > 0.05))
def test_an_exact_power_law_is_recovered_and_chosen(a: float, b: float) -> None:
    y = a * X**b
    found = fit_trend(X, y, 0.01 * np.abs(y))
    assert found.best_law is not None
    assert found.best_law.kind == "power"
    told = draw_coefficients(found.best_law)
    assert (told["a"][0], told["b"][0]) == (pytest.approx(a, rel=1e-7), pytest.approx(b, rel=1e-7))


@settings(max_examples=scale_examples(40))
@given(st.integers(0, 10_000), SCALE, SCALE)
def test_units_of_x_and_y_change_only_the_units_of_the_result(
    seed: int, metre: float, second: float
) -> None:
    x, y, stderr = make_noisy(seed)
    found = fit_trend(x, y, stderr, [30.0])
    other = fit_trend(metre * x, second * y, second * stderr, [30.0 * metre])
    assert found.best_law is not None
    assert other.best_law is not None
    assert other.best_law.kind == found.best_law.kind
    assert other.best_law.birge_ratio == pytest.approx(found.best_law.birge_ratio, rel=1e-5)
    one, two = found.predictions[0], other.predictions[0]
    assert two.value == pytest.approx(second * one.value, rel=1e-5)
    assert two.upper - two.lower == pytest.approx(second * (one.upper - one.lower), rel=1e-5)
    for this, that in zip(found.influences, other.influences, strict=True):
        assert that.studentised == pytest.approx(this.studentised, rel=1e-4, abs=1e-6)


def test_the_line_and_its_covariance_are_those_of_the_textbook() -> None:
    x, y, stderr = make_noisy(1)
    law = fit_line(x, y, stderr)
    (b, a), covariance = np.polyfit(x, y, 1, w=1 / stderr, cov="unscaled")
    told = draw_coefficients(law)
    assert (told["a"][0], told["b"][0]) == (pytest.approx(a), pytest.approx(b))
    assert told["b"][1] == pytest.approx(law.error_factor * covariance[0, 0] ** 0.5)
    assert told["a"][1] == pytest.approx(law.error_factor * covariance[1, 1] ** 0.5)


def test_the_errors_of_a_power_law_are_those_of_its_slopes() -> None:
    x, y, stderr = make_noisy(3)
    law = fit_power(x, y, stderr)
    assert law is not None
    (_, a, a_error), (_, b, b_error) = law.coefficients
    slopes = np.column_stack([x**b, a * x**b * np.log(x)]) / stderr[:, None]
    expected = law.error_factor * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    assert [a_error, b_error] == pytest.approx(expected.tolist(), rel=1e-6)


@pytest.mark.parametrize("seed", range(10))
def test_no_neighbour_of_the_power_law_is_better(seed: int) -> None:
    x, y, stderr = make_noisy(seed)
    law = fit_power(x, y, stderr)
    assert law is not None
    (_, a, da), (_, b, db) = law.coefficients
    for step in np.random.default_rng(seed).normal(size=(50, 2)) * [0.1 * da, 0.1 * db]:
        other = (a + step[0]) * x ** (b + step[1])
        assert np.sum(((y - other) / stderr) ** 2) >= law.chi_squared * (1 - 1e-9)


def test_a_point_of_infinite_error_has_no_weight_and_a_doubled_point_counts_twice() -> None:
    x, y, stderr = make_noisy(2)
    wild = fit_line(np.append(x, 30.0), np.append(y, 1e3), np.append(stderr, 1e9))
    plain = fit_line(x, y, stderr)
    assert wild.evaluate_law(X) == pytest.approx(plain.evaluate_law(X), rel=1e-9)
    twice = fit_line(np.append(x, x[3]), np.append(y, y[3]), np.append(stderr, stderr[3]))
    once = stderr.copy()
    once[3] /= np.sqrt(2)
    assert twice.evaluate_law(X) == pytest.approx(fit_line(x, y, once).evaluate_law(X), rel=1e-12)


@pytest.mark.parametrize("understated", [1.0, 5.0])
def test_intervals_cover_what_they_say_even_where_errors_are_understated(
    understated: float,
) -> None:
    stderr = 0.02 * X
    covered, seeds = np.zeros(3), draw_seeds(gate=400, night=4000)
    for seed in seeds:
        draw = np.random.default_rng([5, seed])
        y = 0.3 * X + 1.0 + stderr * draw.normal(size=5)
        law = fit_line(X, y, stderr / understated)
        told = make_prediction(law, X, stderr / understated, 30.0)
        new = 0.3 * 30.0 + 1.0 + 0.02 * 30.0 * draw.normal()
        covered[0] += told.lower <= new <= told.upper
        error = (
            compute_half_width(law) * law.error_factor * law.evaluate_stderr(np.array([30.0]))[0]
        )
        covered[1] += abs(law.evaluate_law(np.array([30.0]))[0] - 10.0) <= error
        covered[2] += told.upper > told.lower
    # 95 %; more where the stated errors alone already suffice.
    least, most = bound_count(len(seeds), 0.945, 0.955)
    assert covered[2] == len(seeds)
    assert np.all(covered[:2] >= least)
    if understated > 1:
        assert np.all(covered[:2] <= most)


def test_the_deleted_residual_is_that_of_a_fit_without_the_point() -> None:
    x, y, stderr = make_noisy(7)
    for i, one in enumerate(fit_trend_by_line(x, y, stderr)):
        others = fit_line(np.delete(x, i), np.delete(y, i), np.delete(stderr, i))
        at = x[i : i + 1]
        difference = y[i] - others.evaluate_law(at)[0]
        error = others.birge_ratio * np.hypot(others.evaluate_stderr(at)[0], stderr[i])
        assert one.studentised == pytest.approx(difference / error, rel=1e-9)


def fit_trend_by_line(x, y, stderr):  # type: ignore[no-untyped-def]
    from sysid.trends.trend import _compute_influences

    return _compute_influences(fit_line(x, y, stderr), x, y, stderr)


def test_one_wild_point_is_flagged_and_rarely_one_of_a_clean_batch() -> None:
    flagged, seeds = 0, draw_seeds(gate=100, night=2000)
    for seed in seeds:
        draw = np.random.default_rng(seed)
        x = np.arange(1.0, 9.0)
        y = 2.0 + 0.5 * x + 0.1 * draw.normal(size=8)
        flagged += any(one.is_outlier for one in fit_trend(x, y, np.full(8, 0.1)).influences)
    assert flagged <= bound_count(len(seeds), 0.05)[1]
    y[4] += 3.0
    found = fit_trend(x, y, np.full(8, 0.1))
    assert [one.is_outlier for one in found.influences] == [i == 4 for i in range(8)]


def test_the_laws_are_those_of_the_points_without_the_outliers() -> None:
    x = np.arange(1.0, 11.0)
    stderr = np.linspace(0.05, 0.15, 10)
    y = 2.0 + 0.5 * x + stderr * np.random.default_rng(3).normal(size=10)
    y[[2, 7]] += [4.0, -3.0]
    rest = np.delete(np.arange(10), [2, 7])
    found = fit_trend(x, y, stderr, [20.0])
    alone = fit_trend(x[rest], y[rest], stderr[rest], [20.0])
    assert (found.excluded, alone.excluded) == ((2, 7), ())
    assert [law.coefficients for law in found.laws] == [law.coefficients for law in alone.laws]
    assert (found.band, found.predictions) == (alone.band, alone.predictions)
    assert [found.influences[i] for i in rest] == list(alone.influences)
    assert [i for i, one in enumerate(found.influences) if one.is_outlier] == [2, 7]
    assert fit_trend(x[1:], y[1:], stderr[1:]).excluded == (1,)  # one of nine, the worse
    counted = fit_trend(x, y, stderr, outliers="include")
    assert counted.excluded == ()
    assert counted.best_law is not None
    assert counted.best_law.degrees == 8


@pytest.mark.parametrize(("n", "excluded"), [(4, 0), (5, 1), (9, 1), (10, 2)])
def test_at_most_a_fifth_of_the_points_leaves_a_law(n: int, excluded: int) -> None:
    x = np.arange(1.0, n + 1.0)
    y = 2.0 + 0.5 * x + 1e-4 * np.random.default_rng(1).normal(size=n)
    y[[0, 3, -1]] += [60.0, -8.0, 1.0]
    assert len(fit_trend(x, y, np.full(n, 1e-4)).excluded) <= excluded
    y[[0, -1]] -= [60.0, 1.0]
    assert fit_trend(x, y, np.full(n, 1e-4)).excluded == ((3,) if excluded else ())


def test_a_point_that_its_stated_error_explains_is_no_outlier() -> None:
    y = 2.0 + 0.5 * X
    y[1] += 0.1
    wrong, right = (fit_trend(X, y, np.full(5, error)).influences[1] for error in (0.01, 0.2))
    assert wrong.p_value == pytest.approx(right.p_value)
    assert (wrong.is_outlier, right.is_outlier) == (True, False)


@pytest.mark.parametrize("n", [3, 4])
def test_with_few_points_nothing_is_divided_by_nothing(n: int) -> None:
    found = fit_trend(X[:n], [1.0, 2.1, 2.9, 4.2][:n], np.full(n, 0.1), [100.0, 0.0])
    assert found.best_law is not None
    assert found.best_law.aicc == inf
    assert all((one.studentised is None) == (n == 3) for one in found.influences)
    assert [one.is_outside for one in found.predictions] == [True, True]


def test_less_than_three_places_give_a_reason() -> None:
    found = fit_trend([5, 5, 10], [1, 2, 3], [0.1, 0.1, 0.1])
    assert (found.laws, found.best_law) == ((), None)
    assert found.reason.startswith("there are 2 values of x with a standard error")
    assert fit_trend([], [], []).reason.startswith("there are no values of x")
    assert "needs 3" in found.reason


def test_a_power_law_needs_positive_x() -> None:
    found = fit_trend([-1, 0, 1, 2], [1, 2, 3, 4.1], np.full(4, 0.1))
    assert [law.kind for law in found.laws] == ["line"]


def test_means_of_several_runs_carry_the_scatter_between_them() -> None:
    draw = np.random.default_rng(3)
    groups = [[TrendEstimate(x + 0.5 * draw.normal(), 0.1) for _ in range(4)] for x in range(50)]
    means, ratio = pool_estimates(groups)
    assert ratio == pytest.approx(5.0, rel=0.2)
    assert means[0].stderr == pytest.approx(ratio * 0.1 / 2)
    assert means[0].value == pytest.approx(np.mean([one.value for one in groups[0]]))
    assert pool_estimates([[TrendEstimate(1.0, 0.1)]]) == (
        (TrendEstimate(1.0, pytest.approx(0.1)),),
        1.0,
    )


def test_runs_that_agree_by_luck_keep_their_stated_errors() -> None:
    groups = [[TrendEstimate(1.0, 0.1), TrendEstimate(1.02, 0.1)], [TrendEstimate(3.0, 0.2)]]
    means, ratio = pool_estimates(groups)
    assert ratio == pytest.approx(0.02 / (0.1 * 2**0.5))  # one degree of freedom of two runs
    assert [mean.value for mean in means] == pytest.approx([1.01, 3.0])
    assert [mean.stderr for mean in means] == pytest.approx([0.1 / 2**0.5, 0.2])


def test_scatter_has_one_degree_of_freedom_less_than_runs_at_each_label() -> None:
    groups = [[TrendEstimate(value, 0.1) for value in values] for values in ([1, 2, 3], [5, 5.6])]
    means, ratio = pool_estimates(groups)
    assert ratio == pytest.approx(((2.0 + 0.18) / 0.01 / 3) ** 0.5)
    errors = [ratio * 0.1 / 3**0.5, ratio * 0.1 / 2**0.5]
    assert [mean.stderr for mean in means] == pytest.approx(errors)


def test_points_that_lie_on_a_law_by_luck_keep_its_stated_errors() -> None:
    stderr = np.full(5, 0.5)
    lucky = fit_line(X, 0.3 * X + 1.0 + 0.01 * np.array([1, -1, 0, 1, -1]), stderr)
    assert lucky is not None
    assert lucky.birge_ratio < 0.1
    covariance = np.linalg.inv(
        np.column_stack([np.ones(5), X]).T @ np.column_stack([np.ones(5), X])
    )
    (_, _, a), (_, _, b) = lucky.coefficients
    assert [a, b] == pytest.approx((0.5 * np.sqrt(np.diag(covariance))).tolist())
    told = make_prediction(lucky, X, stderr, 20.0)
    assert told.stderr == pytest.approx(float(np.hypot(lucky.evaluate_stderr(X[2:3])[0], 0.5)))
    assert told.upper - told.value == pytest.approx(stats.norm.ppf(0.975) * told.stderr)


def test_where_errors_are_understated_an_interval_is_that_of_student_and_of_the_scatter() -> None:
    stderr = np.full(5, 0.01)
    law = fit_line(X, 0.3 * X + 1.0 + 0.2 * np.array([1, -1, 0, 1, -1]), stderr)
    assert law is not None
    assert law.birge_ratio > 5
    for at in (5.0, 30.0, 200.0):
        told = make_prediction(law, X, stderr, at)
        own = float(np.hypot(law.evaluate_stderr(np.array([at]))[0], 0.01))
        assert told.stderr == pytest.approx(law.birge_ratio * own)
        half = stats.t.ppf(0.975, 3) * told.stderr
        assert (told.lower, told.upper) == pytest.approx((told.value - half, told.value + half))
        assert told.is_outside is (at > 80.0)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_drift_from_a_law_that_scatters_little_counts_the_new_estimates_own_error(
    direction: float,
) -> None:
    """The batch is exact, the new estimate is not: two of its own errors are no drift."""
    stderr = np.full(5, 0.001)
    law = fit_line(X, 0.3 * X + 1.0, stderr)
    assert law is not None
    for size, drifted in ((2.0, False), (3.1, True)):
        new = TrendEstimate(0.3 * 20.0 + 1.0 + direction * size * 0.1, 0.1)
        found = drift_from_law(new, law, X, stderr, 20.0)
        assert found.z == pytest.approx(direction * size, rel=1e-3)
        assert found.has_drifted is drifted
        from_run = compute_drift(new, TrendEstimate(7.0, 1e-9))
        assert (from_run.z, from_run.has_drifted) == (pytest.approx(direction * size), drifted)


def test_of_batches_without_an_outlier_five_percent_are_told_of_one() -> None:
    """A rate of batches, not of points; the stated errors are far too small to explain any."""
    batches, flagged = 600, 0
    draw = np.random.default_rng(21)
    x = np.arange(1.0, 13.0)
    for _ in range(batches):
        y = 2.0 + 0.5 * x + draw.normal(size=12)
        flagged += any(one.is_outlier for one in fit_trend_by_line(x, y, np.full(12, 1e-3)))
    deviation = (0.05 * 0.95 / batches) ** 0.5
    assert abs(flagged / batches - 0.05) <= 3 * deviation


def test_drift_is_flagged_beyond_three_standard_errors() -> None:
    old = TrendEstimate(1.0, 0.03)
    assert compute_drift(TrendEstimate(1.0 + 0.149, 0.04), old).has_drifted is False
    found = compute_drift(TrendEstimate(1.0 + 0.151, 0.04), old)
    assert found.has_drifted is True
    assert found.z == pytest.approx(3.02)
    assert compute_drift(TrendEstimate(1.0 + 0.151, 0.04), old, comparisons=10).has_drifted is False
    assert compute_drift(old, old).z == 0.0


def test_a_batch_without_change_rarely_drifts_from_its_own_law() -> None:
    flags, seeds = 0, draw_seeds(gate=400, night=4000)
    stderr = 0.02 * X
    for seed in seeds:
        draw = np.random.default_rng([9, seed])
        y = 0.3 * X + 1.0 + stderr * draw.normal(size=5)
        law = fit_line(X, y, stderr)
        new = TrendEstimate(0.3 * 30.0 + 1.0 + 0.6 * draw.normal(), 0.6)
        flags += drift_from_law(new, law, X, stderr, 30.0).has_drifted
    assert flags <= bound_count(len(seeds), 0.006)[1]
    moved = TrendEstimate(0.3 * 30.0 + 30.0, 0.6)
    assert drift_from_law(moved, law, X, stderr, 30.0).has_drifted


def test_few_points_that_scatter_as_they_say_are_told_from_a_change_by_three_errors() -> None:
    exact = fit_line(X, 0.3 * X + 1.0, np.full(5, 0.1))
    error = make_prediction(exact, X, np.full(5, 0.1), 30.0).stderr
    for size, has_drifted in ((2.9, False), (3.1, True)):
        new = TrendEstimate(10.0 + size * error, 0.1)
        assert drift_from_law(new, exact, X, np.full(5, 0.1), 30.0).has_drifted is has_drifted


def test_of_five_points_a_gross_change_is_seen_whether_their_errors_are_right_or_not() -> None:
    stderr, seeds = 0.02 * X, draw_seeds(gate=150, night=3000)
    for understated in (1.0, 3.0):
        seen, false = 0, 0
        for seed in seeds:
            draw = np.random.default_rng([2, seed])
            y = 0.3 * X + 1.0 + understated * stderr * draw.normal(size=5)
            law = fit_line(X, y, stderr)
            new = [
                TrendEstimate(0.3 * x + 1.0 + understated * s * draw.normal(), s)
                for x, s in zip(X, stderr, strict=True)
            ]
            found = compute_law_drifts(new, law, X, stderr, X, comparisons=15)
            false += any(one.has_drifted for one in found)
            error = understated * stderr[3]
            moved = TrendEstimate(new[3].value + 15 * error, new[3].stderr)
            seen += drift_from_law(moved, law, X, stderr, 40.0, comparisons=15).has_drifted
        assert seen >= bound_count(len(seeds), 0.97)[0]
        assert false <= bound_count(len(seeds), 0.01 if understated == 1 else 0.12)[1]


def test_the_limit_is_three_and_moderately_more_for_many_comparisons_and_few_points() -> None:
    right, wrong = (
        fit_line(X, 0.3 * X + np.array([0, 1, -1, 1, 0]), np.full(5, s)) for s in (1.0, 0.2)
    )
    assert compute_drift_limit() == pytest.approx(3.0)
    assert compute_drift_limit(right) == pytest.approx(3.0)
    assert compute_drift_limit(None, 15) == pytest.approx(-stats.norm.ppf(stats.norm.sf(3) / 15))
    ratio = stats.t.ppf(0.975, 3) / stats.norm.ppf(0.975)
    assert compute_drift_limit(wrong, 15) == pytest.approx(ratio * compute_drift_limit(right, 15))
    assert compute_drift_limit(wrong, 15) < 6.2
    told = drift_from_law(TrendEstimate(1.0, 0.1), wrong, X, np.full(5, 0.2), 20.0, 15)
    assert told.limit == compute_drift_limit(wrong, 15)


def test_aic_prefers_the_law_that_made_the_data() -> None:
    right, seeds = {"line": 0, "power": 0}, draw_seeds(gate=40, night=1000)
    for seed in seeds:
        noise = np.random.default_rng([11, seed]).normal(size=5)
        line = fit_trend(X, 5.0 + 0.3 * X + 0.05 * noise, np.full(5, 0.05)).best_law
        curve = fit_trend(X, 0.01 * X**1.4 * (1 + 0.02 * noise), 0.0002 * X**1.4).best_law
        right["line"] += line is not None and line.kind == "line"
        right["power"] += curve is not None and curve.kind == "power"
    least, _ = bound_count(len(seeds), 0.97)
    assert right["line"] >= least
    assert right["power"] >= least


def test_aic_is_that_of_the_formula() -> None:
    x, y, stderr = make_noisy(4)
    law = fit_line(x, y, stderr)
    n = x.size
    assert law.aic == pytest.approx(n * log(law.chi_squared / n) + 6)
    assert law.aicc == pytest.approx(law.aic + 24 / (n - 4))


@pytest.mark.parametrize("kind", ["line", "power"])
def test_many_places_at_once_are_told_as_one_after_the_other(kind: str) -> None:
    x, y, stderr = make_noisy(6, n=30)
    law = fit_line(x, y, stderr) if kind == "line" else fit_power(x, y, stderr)
    assert law is not None
    at = np.array([-1.0, 0.0, 1e-3, 7.0, *x, 90.0])
    told = predict_estimates(law, x, stderr, at)
    alone = [make_prediction(law, x, stderr, float(one)) for one in at]
    np.testing.assert_allclose(np.array(told, float), np.array(alone, float), rtol=1e-12)
    new = [TrendEstimate(float(3.0 * one), 0.1) for one in at]
    found = compute_law_drifts(new, law, x, stderr, at, 4)
    one_by_one = [
        drift_from_law(one, law, x, stderr, float(place), 4)
        for one, place in zip(new, at, strict=True)
    ]
    np.testing.assert_allclose(
        np.array(found, float), np.array(one_by_one, float), rtol=1e-9, atol=1e-12
    )


def test_the_error_of_a_new_estimate_lies_between_those_of_its_neighbours() -> None:
    x = np.array([1.0, 1.0, 3.0])
    law = fit_line(np.arange(5.0), np.arange(5.0), np.full(5, 1e-9))
    assert law is not None
    told = predict_estimates(law, x, np.array([1.0, 4.0, 8.0]), np.array([0.5, 1.0, 2.0, 3.0, 9.0]))
    assert [one.stderr for one in told] == pytest.approx([2.0, 2.0, 4.0, 8.0, 8.0], rel=1e-6)


def test_looking_up_the_errors_of_a_batch_is_done_once_not_for_every_estimate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    x, y, stderr = make_noisy(7, n=200)
    law = fit_line(x, y, stderr)
    assert law is not None
    looked, unique = [], np.unique

    def count(*given: Any, **more: Any) -> Any:
        looked.append(1)
        return unique(*given, **more)

    monkeypatch.setattr(np, "unique", count)
    compute_law_drifts([TrendEstimate(1.0, 0.1)] * 200, law, x, stderr, x)
    assert len(looked) == 1


SIZES = st.floats(1e-300, 1e300) | st.floats(-1e300, -1e-300) | st.floats(-10, 10)


@settings(max_examples=scale_examples(300))
@given(st.lists(st.tuples(SIZES, SIZES, st.floats(1e-300, 1e300)), min_size=3, max_size=6))
def test_points_of_any_size_give_finite_laws_or_a_reason(
    points: list[tuple[float, float, float]],
) -> None:
    x, y, stderr = zip(*points, strict=True)
    found = fit_trend(x, y, stderr, [1.0, 1e300])
    assert bool(found.laws) != bool(found.reason)
    for law in found.laws:
        assert np.all(np.isfinite([one[1:] for one in law.coefficients]))
        assert np.all(np.isfinite([law.aic, law.birge_ratio]))
    for one in found.influences:
        assert one.p_value is None or 0 <= one.p_value <= 1


def test_places_that_doubles_cannot_tell_apart_give_no_law_but_a_reason() -> None:
    found = fit_trend([1e-300, 1.0, 2.0, 1e300], [1.0, 2.0, 3.0, 4.0], np.full(4, 0.1))
    assert all(law.kind == "power" for law in found.laws)
    lost = fit_trend([-1e300, 1.0, 2.0, 1e300], [1.0, 2.0, 3.0, 4.0], np.full(4, 0.1))
    assert (lost.laws, lost.best_law) == ((), None)
    assert "-1e+300 to 1e+300" in lost.reason


def test_the_mean_of_runs_with_tiny_errors_is_as_that_of_others() -> None:
    tiny, plain = (
        pool_estimates([[TrendEstimate(s, s), TrendEstimate(3 * s, 2 * s)]])[0]
        for s in (1e-200, 1.0)
    )
    assert tiny[0].value == pytest.approx(1e-200 * plain[0].value)
    assert tiny[0].stderr == pytest.approx(1e-200 * plain[0].stderr)


@pytest.mark.parametrize("offset", [0.0, 1e3])
@pytest.mark.parametrize("least", [1e-5, 1e-7, 1e-10, 1e-13])
def test_a_line_turns_about_a_point_that_is_nearly_exact(least: float, offset: float) -> None:
    x, y = np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, 2.0, 3.0, 4.1]) + offset
    law = fit_line(x, y, np.array([least, 1.0, 1.0, 1.0]))
    assert law is not None
    far, high = x[1:] - x[0], y[1:] - y[0]
    # of order least² from that point free to move; the rest is what rounding of y gives
    assert law.theta[1] == pytest.approx(float(far @ high / (far @ far)), rel=1e-10)


def test_a_steep_decay_is_a_power_law_although_the_square_of_its_factor_overflows() -> None:
    x = [1000.0, 1100.0, 1200.0, 1300.0]
    y = [1000.0 * (one / 1000.0) ** -97.0 for one in x]
    found = fit_trend(x, y, [1e-3 * one for one in y])
    assert found.best_law is not None
    assert found.best_law.kind == "power"
    (_, a, error), (_, b, _) = found.best_law.coefficients
    assert b == pytest.approx(-97.0)
    assert np.isfinite([a, error]).all()
    assert error > 0
