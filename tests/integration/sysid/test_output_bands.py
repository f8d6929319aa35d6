"""Bands of the output: those of regression where it is known, and the plant inside 95 % of them."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom, t

import sysid
from sysid.core.errors import InvalidSettings, RecordTooShort
from sysid.core.settings import GeneticAlgorithm, Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.parse import parse_model
from sysid.results.bands import pool_noise
from sysid.results.figures import draw_figures
from sysid.results.identification import Identification
from sysid.search.refine import refine_candidates
from sysid.simulation.fit_metrics import ChannelMetrics
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.output_bands import ParameterSpread, compute_output_bands

QUICK = GeneticAlgorithm(generations=40)
N = 60
TIMES = 0.1 * np.arange(N)
LINE = {
    "name": "line",
    "form": "differential",
    "states": {"x": "m"},
    "parameters": {"b": {"lower": -10, "upper": 10, "unit": "m/s"}},
    "equations": {"x": "b"},
    "outputs": {"y": "x"},
    "initial": {"x": {"lower": -10, "upper": 10}},
}
LAG = {
    "name": "lag",
    "form": "differential",
    "inputs": {"u": "V"},
    "states": {"x": "V"},
    "parameters": {
        "K": {"lower": 0, "upper": 5, "unit": "1"},
        "T": {"lower": 0.05, "upper": 5, "unit": "s"},
        "L": {"lower": 0, "upper": 2, "unit": "s"},
    },
    "equations": {"x": "(K*u(t - L) - x)/T"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}
TRUTH = {"K": 2.0, "T": 0.7, "L": 0.43}


def make_line(noise: float = 0.3) -> Record:
    y = 1.0 + 0.5 * TIMES + noise * np.random.default_rng(1).standard_normal(N)
    return Record((), (Channel("y", TIMES, y, "m"),))


def make_input(seed: int = 2) -> Channel:
    levels = np.repeat(np.random.default_rng(seed).uniform(-1.0, 1.0, 12), 10)
    return Channel("u", 0.1 * np.arange(120), np.append(np.zeros(10), levels)[:120], "V")


@cache
def simulate_truth() -> Channel:
    return simulate(LAG, make_input(), TRUTH).channel("y")


def make_lag_record(seed: int = 5, noise: float = 0.1) -> Record:
    clean = simulate_truth()
    values = clean.values + noise * np.random.default_rng(seed).standard_normal(120)
    return Record(make_input(), Channel("y", clean.times, values, "V"))


@pytest.fixture(scope="module")
def line() -> Identification:
    return identify(LINE, make_line(), QUICK)


@pytest.fixture(scope="module")
def lag() -> Identification:
    return identify(LAG, make_lag_record(), QUICK)


def compute_regression(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Half widths of both bands of a straight line, from the textbook."""
    columns = np.column_stack([np.ones(N), TIMES])
    rest = values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]
    s = np.sqrt(rest @ rest / (N - 2))
    distance = 1.0 / N + (TIMES - TIMES.mean()) ** 2 / np.sum((TIMES - TIMES.mean()) ** 2)
    factor = t.ppf(0.975, N - 2) * s
    return factor * np.sqrt(distance), factor * np.sqrt(1.0 + distance)


def test_bands_of_a_line_are_those_of_linear_regression(line: Identification) -> None:
    [bands] = line.compute_bands()
    confidence, prediction = compute_regression(make_line().outputs[0].values)
    for ends, half in ((bands.confidence, confidence), (bands.prediction, prediction)):
        assert bands.simulated - ends[:, 0] == pytest.approx(half, rel=1e-5)
        assert ends[:, 1] - bands.simulated == pytest.approx(half, rel=1e-5)
    assert (bands.output, bands.unit, bands.source) == ("y", "m", "covariance")
    assert np.array_equal(bands.times, TIMES)
    assert bands.simulated == pytest.approx(line.simulated[0][0], abs=1e-12)


def test_samples_of_the_posterior_give_the_same_bands_in_a_linear_model() -> None:
    [bands] = identify(LINE, make_line(), QUICK, posterior=True).compute_bands()
    confidence, prediction = compute_regression(make_line().outputs[0].values)
    assert bands.source == "posterior"
    for ends, half in ((bands.confidence, confidence), (bands.prediction, prediction)):
        assert 0.5 * np.diff(ends, axis=1)[:, 0] == pytest.approx(half, rel=0.2)
        assert np.all(ends[:, 0] < bands.simulated)
        assert np.all(bands.simulated < ends[:, 1])


def test_bands_hold_the_output_and_a_new_measurement_in_95_percent_of_the_draws() -> None:
    """At one time of each draw, so that the draws are independent; limits hold in 99.8 %."""
    draws, noise = 300, 0.1
    model = parse_model(LAG)
    clean = simulate_truth().values
    random = np.random.default_rng(11)
    problem = Problem.build(model, [make_lag_record()])
    hits = np.zeros(2, dtype=np.int64)
    for _ in range(draws):
        drawn = problem.replace_outputs([make_lag_record(int(random.integers(2**31)), noise)])
        start = np.array([TRUTH[name] for name in drawn.free_names])
        [end] = refine_candidates(drawn, [start])
        assert end is not None
        uncertainty = analyse_estimate(drawn, end.theta).uncertainty
        assert uncertainty is not None
        degrees = drawn.n_scored - 3
        deviation = {(0, "y"): end.rms * np.sqrt(drawn.n_scored / degrees)}
        spread = ParameterSpread(
            uncertainty.names, uncertainty.covariance, uncertainty.degrees, degrees
        )
        [[bands]] = compute_output_bands(drawn, end.theta, spread, deviation)
        k = int(random.integers(15, 120))
        new = clean[k] + noise * random.standard_normal()
        for i, (ends, value) in enumerate(((bands.confidence, clean[k]), (bands.prediction, new))):
            hits[i] += ends[k, 0] <= value <= ends[k, 1]
    low, high = binom.interval(0.998, draws, 0.95)
    assert np.all((low <= hits) & (hits <= high)), hits


def test_a_band_is_as_wide_as_the_interval_where_few_samples_count() -> None:
    """At the beginning the output is its initial state, under noise as slow as the record."""
    slow = lfilter([0.1], [1.0, -0.9], np.random.default_rng(5).standard_normal(N))
    record = make_line(0.0)
    noisy = replace(record.outputs[0], values=record.outputs[0].values + slow)
    found = identify(LINE, Record((), (noisy,)), QUICK, loss=Loss(noise_model="white"))
    assert found.degrees < 20
    interval = found["x(0)"].interval95
    assert interval is not None
    [bands] = found.compute_bands()
    widest = np.ptp(bands.confidence[0])
    assert np.ptp(interval) == pytest.approx(widest, rel=0.15)
    assert np.ptp(interval) <= widest * (1 + 1e-9)


def test_bands_on_new_inputs_surround_what_simulate_gives(lag: Identification) -> None:
    new = make_input(9)
    [bands] = lag.compute_bands(new)
    expected = simulate(LAG, new, lag).channel("y")
    assert np.array_equal(bands.times, expected.times)
    assert bands.simulated == pytest.approx(expected.values, abs=1e-9)
    inside = np.diff(bands.confidence, axis=1)[20:, 0]
    assert np.all(inside > 0)
    assert np.all(np.diff(bands.prediction, axis=1)[20:, 0] > inside)
    other = lag.compute_bands(Channel("valve", new.times, new.values), channels={"u": "valve"})
    assert np.array_equal(other[0].confidence, bands.confidence)


def test_bands_cover_the_part_that_was_kept_for_validation() -> None:
    found = identify(LAG, make_lag_record(), QUICK, validation_fraction=0.3)
    [bands] = found.compute_bands()
    assert bands.times.size == 120
    whole = np.concatenate([found.simulated[0][0], found.simulated_validation[0][0]])
    assert bands.simulated == pytest.approx(whole, abs=1e-9)


def test_the_figure_of_the_response_has_the_bands_of_its_record(lag: Identification) -> None:
    [(_, figure)] = draw_figures(lag, ["response"])
    drawn = {trace["name"]: np.array(trace["y"], dtype=np.float64) for trace in figure["data"]}
    [bands] = lag.compute_bands()
    assert drawn["95 % confidence band"] == pytest.approx(bands.confidence[:, 1])
    assert drawn["95 % prediction band, lower end"] == pytest.approx(bands.prediction[:, 0])
    names = [trace["name"] for trace in figure["data"]]
    assert names.index("95 % prediction band") < names.index("95 % confidence band")
    assert names.index("95 % confidence band") < names.index("measured")
    without = draw_figures(replace(lag, covariance=None), ["response"])[0][1]
    assert without["data"][0]["name"] == "measured"


def test_a_tied_parameter_moves_with_those_it_is_tied_to() -> None:
    ties: dict[str, Any] = {"T": {"tied": "0.35*K"}}
    [tied] = identify(LAG, make_lag_record(), QUICK, parameters=ties).compute_bands()
    parameters = {name: LAG["parameters"][name] for name in "KL"}  # type: ignore[index]
    written = {**LAG, "parameters": parameters, "equations": {"x": "(K*u(t - L) - x)/(0.35*K)"}}
    [same] = identify(written, make_lag_record(), QUICK).compute_bands()
    assert tied.confidence == pytest.approx(same.confidence, abs=1e-4)


def test_several_records_have_bands_with_noise_of_their_own() -> None:
    records = [make_lag_record(5, 0.02), make_lag_record(6, 0.2)]
    found = identify(LAG, records, QUICK)
    first, second = (found.compute_bands(experiment=e)[0] for e in (0, 1))
    widths = [np.diff(one.prediction, axis=1).mean() for one in (first, second)]
    assert widths[1] > 5 * widths[0]
    noise = pool_noise(found.agreement.estimation, 237.0)
    assert noise[0, "y"] == pytest.approx(np.sqrt((0.02**2 + 0.2**2) / 2), rel=0.15)
    metrics = [ChannelMetrics(0, "y", "V", 10, 0.3, 0.0), ChannelMetrics(1, "y", "V", 30, 0.1, 0.0)]
    assert pool_noise(metrics, 40.0)[0, "y"] == pytest.approx(np.sqrt(0.03))


def test_what_has_no_bands_says_why(lag: Identification, tmp_path: Any) -> None:
    with pytest.raises(InvalidSettings, match="found 1; the result has 1 records"):
        lag.compute_bands(experiment=1)
    with pytest.raises(RecordTooShort):
        lag.compute_bands(Channel("u", [0.0, 0.01], [0.0, 1.0]))
    short = Record(make_input(), Channel("y", [0.0, 5.0, 8.0], [0.0, 1.0, 1.1], "V"))
    with pytest.raises(InvalidSettings, match="no standard errors, so there are no bands"):
        identify(LAG, short, QUICK).compute_bands()
    lag.save(tmp_path / "lag.json")
    again = sysid.Identification.load(tmp_path / "lag.json")
    assert np.array_equal(again.compute_bands()[0].prediction, lag.compute_bands()[0].prediction)
