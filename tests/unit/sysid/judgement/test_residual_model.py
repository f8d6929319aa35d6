"""The likelihood of residuals under columns and coloured noise, against closed forms."""

from itertools import product

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid.core.types import FloatArray
from sysid.judgement.lagged_products import OutputNoise
from sysid.judgement.levels import DEFECT_GAIN
from sysid.judgement.residual_model import ResidualModel
from sysid.residuals.series import ResidualPart
from tests.support.profiles import draw_seeds

N = 400


def make_parts(*sizes: int, outputs: tuple[str, ...] = ()) -> list[ResidualPart]:
    """Series one after another, of one output or of those that are named."""
    ends = np.cumsum((0, *sizes)).tolist()
    names = outputs or ("y",) * len(sizes)
    return [
        ResidualPart(number, name, slice(first, last), np.arange(float(last - first)), 1.0)
        for number, (name, first, last) in enumerate(zip(names, ends[:-1], ends[1:], strict=True))
    ]


def make_model(
    residuals: FloatArray, columns: FloatArray, parts: list[ResidualPart] | None = None
) -> ResidualModel:
    return ResidualModel(residuals, columns, parts or make_parts(residuals.size))


def draw_columns(n: int, count: int, seed: int) -> FloatArray:
    """A column of ones, and smooth ones."""
    random = np.random.default_rng([seed, 1])
    smooth = np.cumsum(random.standard_normal((n, count)), axis=0) / np.sqrt(n)
    return np.column_stack([np.ones(n), smooth])[:, :count]


def draw_noise(n: int, weights: tuple[float, ...], seed: int) -> FloatArray:
    """Draw an autoregression with such weights, and innovations of variance 1."""
    white = np.random.default_rng([seed, 2]).standard_normal(n + 300)
    return np.asarray(lfilter([1.0], [1.0, *(-w for w in weights)], white)[300:])


def compute_rest(residuals: FloatArray, columns: FloatArray) -> float:
    """Compute the sum of squares that least squares leaves."""
    left = residuals - columns @ np.linalg.lstsq(columns, residuals, rcond=None)[0]
    return float(left @ left)


def compute_gain(model: ResidualModel, columns: FloatArray, counted: int = 0) -> float:
    return model.without.criterion - model.fit(columns, counted).criterion


@pytest.mark.parametrize(("n", "count", "counted"), [*product((19, 400), (1, 3), (0, 2))])
def test_in_white_noise_the_gain_is_the_ratio_of_squares_less_the_penalty(
    n: int, count: int, counted: int
) -> None:
    slopes, columns = draw_columns(n, 2, 1), draw_columns(n, count + 2, 2)[:, 2:]
    residuals = draw_noise(n, (), 5) + 0.8 * columns[:, 0]
    model = make_model(residuals, slopes)
    fit = model.fit(columns, counted)
    assert not fit.is_coloured
    if model.without.is_coloured:
        pytest.fail("the draw is not one of white noise")
    joint = np.hstack([slopes, columns])
    ratio = compute_rest(residuals, slopes) / compute_rest(residuals, joint)
    expected = n * np.log(ratio) - (count + counted) * np.log(n)
    assert compute_gain(model, columns, counted) == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_in_white_noise_coefficients_and_errors_are_those_of_least_squares() -> None:
    slopes, columns = draw_columns(N, 2, 1), draw_columns(N, 3, 2)[:, 1:]
    residuals = 3.0 * draw_noise(N, (), 5) + slopes @ [0.5, -2.0] + columns @ [1.0, 4.0]
    joint = np.hstack([slopes, columns])
    expected = np.linalg.lstsq(joint, residuals, rcond=None)[0]
    spread = compute_rest(residuals, joint) / (N - 4)
    errors = np.sqrt(np.diag(np.linalg.inv(joint.T @ joint)) * spread)
    fit = make_model(residuals, slopes).fit(columns)
    assert not fit.is_coloured
    np.testing.assert_allclose(fit.coefficients, expected, rtol=1e-6)
    np.testing.assert_allclose(fit.errors, errors, rtol=1e-6)


def whiten_by_hand(noise: OutputNoise, n: int) -> FloatArray:
    """Build the matrix (n, n) that whitens a series."""
    order, matrix = noise.weights.size, np.eye(n)
    for row in range(order, n):
        matrix[row, row - order : row] = -noise.weights[::-1]
    matrix[order:] /= np.sqrt(noise.innovation_variance)
    matrix[:order] /= np.sqrt(noise.variance)
    return matrix


@pytest.mark.parametrize("weights", [(0.8,), (1.2, -0.5)])
def test_in_coloured_noise_they_are_those_of_generalised_least_squares(
    weights: tuple[float, ...],
) -> None:
    slopes, columns = draw_columns(N, 2, 1), draw_columns(N, 2, 2)[:, 1:]
    residuals = draw_noise(N, weights, 7) + slopes @ [0.5, -2.0] + 3.0 * columns[:, 0]
    fit = make_model(residuals, slopes).fit(columns)
    (noise,) = fit.noise
    assert noise.weights.size == len(weights)
    np.testing.assert_allclose(noise.weights, weights, atol=0.15)
    assert noise.innovation_variance == pytest.approx(1.0, rel=0.2)
    white = whiten_by_hand(noise, N)
    joint = np.hstack([slopes, columns])
    expected, rest, _, _ = np.linalg.lstsq(white @ joint, white @ residuals, rcond=None)
    inverse = np.linalg.inv((white @ joint).T @ (white @ joint))
    np.testing.assert_allclose(fit.coefficients, expected, rtol=1e-6)
    np.testing.assert_allclose(fit.errors, np.sqrt(np.diag(inverse) * rest[0] / (N - 3)), rtol=1e-6)
    np.testing.assert_allclose(fit.innovations @ fit.innovations, rest[0], rtol=1e-6)


@pytest.mark.parametrize("weights", [(), (0.7,), (1.2, -0.5)])
def test_whitening_of_the_true_noise_leaves_white_innovations_of_variance_1(
    weights: tuple[float, ...],
) -> None:
    values = draw_noise(20_000, weights, 3)
    noise = OutputNoise(np.array(weights), float(np.var(values)), 1.0)
    white = noise.whiten(values)
    assert np.var(white) == pytest.approx(1.0, rel=0.05)
    for lag in (1, 2, 3):
        assert abs(float(np.mean(white[lag:] * white[:-lag]))) < 0.03
    columns = np.column_stack([values, 2.0 * values])
    np.testing.assert_allclose(noise.whiten(columns)[:, 1], 2.0 * white)


def test_noise_is_estimated_with_the_explanation_and_not_before_it() -> None:
    """A step is a slow disturbance to whoever estimates the noise first."""
    late = np.where(np.arange(N) > 150, 1.0, 0.0)
    white = 0.3 * draw_noise(N, (), 2)
    model = make_model(white + late, draw_columns(N, 1, 1))
    assert model.without.is_coloured
    fit = model.fit(late[:, None], 1)
    assert not fit.is_coloured
    assert fit.coefficients[-1] == pytest.approx(1.0, abs=4 * fit.errors[-1])
    assert fit.errors[-1] == pytest.approx(0.3 / np.sqrt(N * 0.375 * 0.625), rel=0.2)
    # What the noise of no explanation, kept, would leave of the gain.
    first = model.without.noise
    whitened = model.whiten(np.column_stack([model.columns, late, model.residuals]), first)
    before = compute_rest(whitened[:, -1], whitened[:, :1])
    after = compute_rest(whitened[:, -1], whitened[:, :2])
    assert compute_gain(model, late[:, None], 1) > 2 * N * np.log(before / after) + DEFECT_GAIN


def draw_explanations(seed: int) -> list[FloatArray]:
    """Draw columns that explain nothing: a step, a ramp, a wave, a random walk, noise."""
    random = np.random.default_rng([seed, 3])
    n = np.arange(N)
    return [
        np.where(n > random.integers(30, N - 30), 1.0, 0.0),
        n / N - 0.5,
        np.sin(2 * np.pi * n / random.uniform(20, N) + random.uniform(0, 6)),
        np.cumsum(random.standard_normal(N)),
        random.standard_normal(N),
    ]


@pytest.mark.parametrize("weights", [(), (0.6,), (0.95,), (1.2, -0.5), (0.3, 0.5)])
def test_noise_of_any_colour_raises_no_alarm(weights: tuple[float, ...]) -> None:
    alarms = 0
    for seed in draw_seeds(gate=200, night=2000):
        model = make_model(draw_noise(N, weights, seed), draw_columns(N, 2, seed))
        columns = draw_explanations(seed)[seed % 5]
        alarms += compute_gain(model, columns[:, None], 1) > DEFECT_GAIN
    assert alarms == 0


@pytest.mark.parametrize("weights", [(), (0.7,)])
def test_errors_are_the_spread_of_the_coefficients(weights: tuple[float, ...]) -> None:
    column = draw_explanations(0)[2][:, None]
    fits = [
        make_model(draw_noise(N, weights, seed), draw_columns(N, 2, 1)).fit(column)
        for seed in range(150)
    ]
    distances = [fit.coefficients[-1] / fit.errors[-1] for fit in fits]
    assert np.std(distances) == pytest.approx(1.0, abs=0.2)
    assert abs(np.mean(distances)) < 0.3


def test_a_column_that_a_parameter_has_already_gains_nothing() -> None:
    slopes = draw_columns(N, 3, 1)
    model = make_model(draw_noise(N, (), 5) + slopes @ [1.0, 2.0, 3.0], slopes)
    for columns in (slopes[:, :1], slopes @ np.array([[1.0, 0.5], [2.0, 0.1], [-1.0, 0.3]])):
        fit = model.fit(columns)
        assert np.all(np.isfinite(fit.coefficients))
        assert np.all(np.isfinite(fit.errors))
        expected = -columns.shape[1] * np.log(N)
        assert compute_gain(model, columns) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("columns", [np.zeros((N, 1)), np.zeros((N, 0)), np.ones((N, 2))])
def test_empty_and_equal_columns_are_no_failure(columns: FloatArray) -> None:
    model = make_model(draw_noise(N, (), 5), draw_columns(N, 1, 1))
    fit = model.fit(columns)
    assert np.isfinite(fit.criterion)
    assert np.all(np.isfinite(fit.coefficients))
    assert compute_gain(model, columns) <= 1e-6


def test_parameters_without_effect_do_not_change_a_gain() -> None:
    slopes, column = draw_columns(N, 2, 1), draw_explanations(0)[0][:, None]
    residuals = draw_noise(N, (0.6,), 5) + column[:, 0]
    idle = np.column_stack([slopes, np.zeros(N), slopes[:, 0]])
    own, other = make_model(residuals, slopes), make_model(residuals, idle)
    assert compute_gain(other, column) == pytest.approx(compute_gain(own, column), rel=1e-3)


@pytest.mark.parametrize("size", [1.0, 1e-12, 1e12])
def test_residuals_without_noise_give_the_coefficient_and_finite_numbers(size: float) -> None:
    column = draw_explanations(1)[2]
    model = make_model(2.0 * size * column, size * draw_columns(N, 2, 1))
    fit = model.fit(size * column[:, None])
    assert fit.coefficients[-1] == pytest.approx(2.0)
    assert np.isfinite(fit.criterion)
    assert np.all(np.isfinite(fit.errors))
    assert compute_gain(model, size * column[:, None]) > 1000


def test_constant_residuals_are_explained_by_a_constant() -> None:
    model = make_model(np.full(N, 3.0), draw_columns(N, 3, 1)[:, 1:])
    fit = model.fit(np.ones((N, 1)))
    assert fit.coefficients[-1] == pytest.approx(3.0)
    assert compute_gain(model, np.ones((N, 1))) > 1000


def test_units_of_outputs_and_columns_do_not_matter() -> None:
    slopes, column = draw_columns(N, 2, 1), draw_explanations(0)[0][:, None]
    residuals = draw_noise(N, (0.6,), 5) + column[:, 0]
    gain = compute_gain(make_model(residuals, slopes), column)
    scaled = make_model(1e6 * residuals, slopes * [1e-9, 1e9])
    assert compute_gain(scaled, 1e-3 * column) == pytest.approx(gain, rel=1e-6)
    fit, other = make_model(residuals, slopes).fit(column), scaled.fit(1e-3 * column)
    np.testing.assert_allclose(
        other.coefficients, fit.coefficients * np.array([1e15, 1e-3, 1e9]), rtol=1e-6
    )
    np.testing.assert_allclose(other.errors, fit.errors * [1e15, 1e-3, 1e9], rtol=1e-6)


def test_each_output_has_a_noise_of_its_own_and_experiments_share_it() -> None:
    first, second, third = (
        draw_noise(N, (0.8,), 1),
        draw_noise(N, (0.8,), 2),
        100 * draw_noise(N, (), 3),
    )
    parts = make_parts(N, N, N, outputs=("y", "y", "z"))
    residuals = np.concatenate([first, second, third])
    model = make_model(residuals, np.ones((3 * N, 1)), parts)
    y, z = model.without.noise
    assert y.weights == pytest.approx([0.8], abs=0.1)
    assert z.weights.size == 0
    assert z.innovation_variance == pytest.approx(1e4, rel=0.2)
    # The large noise of z does not hide what is small in y.
    column = np.zeros(3 * N)
    column[:N] = draw_explanations(4)[4]
    small = make_model(residuals + 0.5 * column, np.ones((3 * N, 1)), parts)
    assert compute_gain(small, column[:, None]) > DEFECT_GAIN
    assert compute_gain(model, column[:, None]) < DEFECT_GAIN


def test_a_series_is_not_filtered_across_the_border_of_an_experiment() -> None:
    model = make_model(np.zeros(2 * N), np.ones((2 * N, 1)), make_parts(N, N))
    noise = (OutputNoise(np.array([0.9]), 1.0, 0.19),)
    whitened = model.whiten(np.concatenate([np.full(N, 5.0), np.full(N, -5.0)]), noise)
    np.testing.assert_allclose(whitened[:N], -whitened[N:])


@pytest.mark.parametrize("sizes", [(19,), (10, 9), (1,) * 40])
def test_few_samples_have_white_noise(sizes: tuple[int, ...]) -> None:
    n = sum(sizes)
    model = make_model(draw_noise(n, (0.9,), 1), np.ones((n, 1)), make_parts(*sizes))
    assert not model.without.is_coloured


def test_a_repeated_fit_is_the_same_and_changes_nothing() -> None:
    residuals, slopes = draw_noise(N, (0.6,), 5), draw_columns(N, 2, 1)
    column = draw_explanations(0)[0][:, None]
    model = make_model(residuals.copy(), slopes.copy())
    first, second = model.fit(column), model.fit(column)
    assert first.criterion == second.criterion
    np.testing.assert_array_equal(first.coefficients, second.coefficients)
    np.testing.assert_array_equal(model.residuals, residuals)
    np.testing.assert_array_equal(model.columns, slopes)


@pytest.mark.parametrize("sizes", [(300, 15), (300, 3, 1), (40,) * 10, (10,) * 40])
def test_short_series_do_not_hide_the_colour_of_an_output(sizes: tuple[int, ...]) -> None:
    series = [draw_noise(size, (0.9,), seed) for seed, size in enumerate(sizes)]
    parts = make_parts(*sizes)
    late = np.concatenate([np.arange(size) > size // 2 for size in sizes])
    residuals = np.concatenate(series)
    model = make_model(residuals, np.ones((residuals.size, 1)), parts)
    (noise,) = model.without.noise
    assert noise.weights[0] == pytest.approx(0.9, abs=0.25)
    assert compute_gain(model, late[:, None].astype(np.float64), 1) < DEFECT_GAIN


def whiten_parts(noise: dict[str, OutputNoise], parts: list[ResidualPart]) -> FloatArray:
    """Build the matrix (n, n) that whitens all series."""
    matrix = np.zeros((parts[-1].rows.stop, parts[-1].rows.stop))
    for part in parts:
        matrix[part.rows, part.rows] = whiten_by_hand(noise[part.output], part.times.size)
    return matrix


def fit_autoregression(series: list[FloatArray]) -> OutputNoise:
    """Fit an autoregression of up to six lags to series, by Schwarz's criterion."""
    sizes = [one.size for one in series]
    most = max(p for p in range(7) if sum(n for n in sizes if n >= 2 * p) >= 20 * p)
    lags = [
        np.column_stack([one[most - lag : one.size - lag] for lag in range(most + 1)])
        for one in series
        if one.size >= 2 * most
    ]
    values = np.concatenate(lags)
    found = []
    for order in range(most + 1):
        past = values[:, 1 : order + 1]
        weights = np.linalg.lstsq(past, values[:, 0], rcond=None)[0]
        power = float(np.mean((values[:, 0] - past @ weights) ** 2))
        criterion = len(values) * np.log(power) + order * np.log(len(values))
        found.append((criterion, weights, power))
    _, weights, power = min(found, key=lambda one: one[0])
    return OutputNoise(weights, found[0][2], power)


def fit_by_samples(
    residuals: FloatArray, joint: FloatArray, parts: list[ResidualPart]
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Fit columns (n, k) as the module says it, sample by sample.

    Returns the criterion with the orders of the noise only, coefficients, errors, innovations.
    """
    names = list(dict.fromkeys(part.output for part in parts))
    series = {name: [part.rows for part in parts if part.output == name] for name in names}
    coefficients = np.linalg.lstsq(joint, residuals, rcond=None)[0]
    for _ in range(2):
        left = residuals - joint @ coefficients
        noise = {name: fit_autoregression([left[r] for r in series[name]]) for name in names}
        white = whiten_parts(noise, parts)
        coefficients = np.linalg.lstsq(white @ joint, white @ residuals, rcond=None)[0]
    rest = white @ (residuals - joint @ coefficients)
    (n, k), criterion = joint.shape, 2.0 * -np.linalg.slogdet(white)[1]
    for name, one in noise.items():
        own = np.concatenate([rest[r] for r in series[name]])
        criterion += own.size * np.log(np.mean(own**2)) + one.weights.size * np.log(n)
    inverse = np.linalg.inv((white @ joint).T @ (white @ joint))
    return criterion, coefficients, np.sqrt(np.diag(inverse) * (rest @ rest) / (n - k)), rest


@pytest.mark.parametrize("weights", [(), (0.8,), (1.6, -0.8)])
@pytest.mark.parametrize(
    ("sizes", "outputs"),
    [
        ((200,), ()),
        ((130, 9, 60), ()),
        ((12,) * 12, ()),
        ((90, 3, 1, 90), ("y", "y", "z", "z")),
        ((19,), ()),
    ],
)
def test_products_give_what_whitened_samples_give(
    sizes: tuple[int, ...], outputs: tuple[str, ...], weights: tuple[float, ...]
) -> None:
    """For many explanations at a time, of one column and two, beside what is taken."""
    parts, n = make_parts(*sizes, outputs=outputs), sum(sizes)
    slopes, taken = draw_columns(n, 2, 1), draw_columns(n, 2, 8)[:, 1:]
    explanations = [draw_columns(n, 2 + i % 2, i + 10)[:, 1:] for i in range(7)]
    counted = [i % 3 for i in range(7)]
    residuals = np.concatenate([draw_noise(size, weights, i) for i, size in enumerate(sizes)])
    model = make_model(residuals + taken[:, 0] + 2.0 * explanations[4][:, 0], slopes, parts)
    fits = model.fit_each(explanations, counted, [taken])
    for fit, columns, more in zip(fits, explanations, counted, strict=True):
        joint, used = np.hstack([slopes, taken, columns]), 1 + columns.shape[1] + more
        criterion, coefficients, errors, rest = fit_by_samples(model.residuals, joint, parts)
        assert fit.criterion == pytest.approx(criterion + used * np.log(n), abs=1e-6)
        np.testing.assert_allclose(fit.coefficients, coefficients, atol=1e-6 * errors.max())
        np.testing.assert_allclose(fit.errors, errors, rtol=1e-6)
        np.testing.assert_allclose(fit.innovations, rest, atol=1e-6)
        again = model.fit(np.hstack([taken, columns]), more)
        assert again.criterion == pytest.approx(fit.criterion, abs=1e-8)
