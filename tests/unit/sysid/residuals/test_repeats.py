"""Errors of samples pooled from repeats, against a linear model that leaves each repeat out."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.errors import InvalidRecord
from sysid.core.types import FloatArray, IntArray
from sysid.data.derivations import derive_recording
from sysid.data.records import Channel, Record, Recording, Segment
from sysid.identification.identify import identify
from sysid.models.parse import parse_model
from sysid.residuals.sandwich import count_repeats, estimate_sandwich
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate
from tests.support.library.small_models import LINE
from tests.support.profiles import draw_seeds
from tests.support.random_bounds import bound_count

MODEL = parse_model(LINE)
TRUTH = np.array([2.0, 1.0])
EACH, PERIOD = 12, 0.1


def draw_repeats(count: int, seed: int) -> Recording:
    """Repeats of one ramp, each with its own phase, gain and offset."""
    random = np.random.default_rng(seed)
    times, y, segments, start = [], [], [], 0.0
    for number in range(count):
        own = random.uniform(0, PERIOD) + PERIOD * np.arange(EACH)
        gain, offset = TRUTH + [0.3, 0.2] * random.standard_normal(2)
        times.append(start + own)
        y.append(gain * own + offset + 0.02 * random.standard_normal(EACH))
        first, last = float(times[-1][0]), float(times[-1][-1])
        segments.append(Segment(first, last, origin=float(own[0]), labels={"n": number}))
        start += 3.0
    t = np.concatenate(times)
    u = np.concatenate([one - 3.0 * n for n, one in enumerate(times)])
    return Recording((Channel("u", t, u), Channel("y", t, np.concatenate(y))), tuple(segments))


def pool(recording: Recording) -> Record:
    step = {"input": "u", "outputs": ["y"], "bin": 0.02}
    return derive_recording(recording, [{"pool": step}]).to_record({"u": "u"}, {"y": "y"})


def fit_line(problem: Problem) -> tuple[FloatArray, FloatArray, IntArray]:
    """The regressors, the residuals, and the repeat of each sample."""
    channel = problem.records[0].outputs[0]
    zero, one = problem.predict(np.array([[0.1, 0.0], [1.1, 0.0]]))
    columns = np.column_stack([one - zero, np.ones(zero.size)])
    theta = np.linalg.lstsq(columns, channel.values, rcond=None)[0]
    assert channel.repeats is not None
    return columns, channel.values - columns @ theta, channel.repeats.astype(int)


def test_the_covariance_is_that_of_the_jackknife_over_repeats() -> None:
    problem = Problem.build(MODEL, [pool(draw_repeats(9, 1))])
    columns, error, repeats = fit_line(problem)
    y = problem.records[0].outputs[0].values
    left_out = np.array(
        [
            np.linalg.lstsq(columns[repeats != g], y[repeats != g], rcond=None)[0]
            for g in np.unique(repeats)
        ]
    )
    move = left_out - np.linalg.lstsq(columns, y, rcond=None)[0]
    found = estimate_sandwich(problem, error, columns)
    assert found is not None
    inverse = np.linalg.inv(columns.T @ columns)
    widening = found.equivalent_samples / found.degrees
    covariance = widening * inverse @ found.middle @ inverse
    np.testing.assert_allclose(covariance, 8 / 9 * move.T @ move, rtol=1e-8)


def test_intervals_of_pooled_repeats_cover_the_truth() -> None:
    held, plain = [], []
    for seed in draw_seeds(gate=60, night=400):
        record = pool(draw_repeats(12, seed))
        columns, _, _ = fit_line(Problem.build(MODEL, [record]))
        theta = np.linalg.lstsq(columns, record.outputs[0].values, rcond=None)[0]
        without = replace(record, outputs=(replace(record.outputs[0], repeats=None),))
        for one, counts in ((record, held), (without, plain)):
            problem = Problem.build(MODEL, [one])
            for estimate, true in zip(
                analyse_estimate(problem, theta).estimates, TRUTH, strict=True
            ):
                assert estimate.interval95 is not None
                counts.append(estimate.interval95[0] <= true <= estimate.interval95[1])
    least, most = bound_count(len(held), 0.93, 0.98)
    assert least <= sum(held) <= most
    assert sum(plain) < 0.8 * len(plain)


def forget_repeats(record: Record) -> Record:
    return replace(record, outputs=(replace(record.outputs[0], repeats=None),))


def is_clustered(problem: Problem, columns: FloatArray, error: FloatArray) -> bool:
    found = estimate_sandwich(problem, error, columns)
    return found is not None and found.is_clustered


def test_a_record_that_was_not_pooled_is_one_repeat() -> None:
    pooled, alone = pool(draw_repeats(9, 2)), forget_repeats(pool(draw_repeats(1, 3)))
    whole = Problem.build(MODEL, [pooled, alone])
    parts = [fit_line(Problem.build(MODEL, [one]))[0] for one in (pooled, pool(draw_repeats(1, 3)))]
    columns = np.vstack(parts)
    error = np.random.default_rng(1).standard_normal(len(columns))
    found = estimate_sandwich(whole, error, columns)
    assert found is not None
    assert found.is_clustered
    # Two repeats of equal samples say as much as one degree of freedom, and not as two samples.
    assert 4.0 < found.compute_degrees(np.linalg.inv(columns.T @ columns)[0]) < 9.0
    # What the record alone tells of a parameter of its own has no spread over repeats.
    own = np.zeros((len(columns), 1))
    own[-EACH:] = 1.0
    assert not is_clustered(whole, np.hstack([columns, own]), error)
    assert count_repeats(whole) == 10
    assert count_repeats(Problem.build(MODEL, [alone])) == 0


def test_a_result_says_that_there_are_too_few_repeats_for_its_errors() -> None:
    few = pool(draw_repeats(3, 2))
    problem = Problem.build(MODEL, [few])
    columns, error, _ = fit_line(problem)
    assert not is_clustered(problem, columns, error)
    (told,) = [text for text in identify(LINE, few).warnings if "repeats" in text]
    assert "pooled from 3 repeats" in told
    assert "at least 5" in told
    assert not any("repeats" in text for text in identify(LINE, forget_repeats(few)).warnings)


def test_a_result_says_that_its_errors_are_by_repeat_and_stays_in_the_bounds() -> None:
    found = identify(
        LINE, pool(draw_repeats(8, 3)), parameters={"b": {"lower": 0.97, "upper": 1.5}}
    )
    assert found.noise_colour == "clustered"
    interval = found["b"].interval95
    assert interval is not None
    assert interval[0] >= 0.97
    assert interval[1] <= 1.5


def test_the_posterior_has_the_errors_of_whole_repeats() -> None:
    found = identify(LINE, pool(draw_repeats(12, 1)), posterior=True)
    assert found.posterior is not None
    for sampled in found.posterior.parameters:
        interval = found[sampled.name].interval95
        assert interval is not None
        assert np.ptp(sampled.interval95) == pytest.approx(np.ptp(interval), rel=0.1)
    assert not any("by the posterior" in text for text in found.warnings)


def test_bands_cover_pooled_samples_that_were_kept_for_validation() -> None:
    record = pool(draw_repeats(8, 3))
    [bands] = identify(LINE, record, validation_fraction=0.3).compute_bands()
    np.testing.assert_array_equal(bands.times, record.outputs[0].times)


def test_pooled_samples_keep_the_number_of_their_repeat_when_they_are_cut() -> None:
    channel = pool(draw_repeats(4, 4)).outputs[0]
    assert channel.repeats is not None
    assert np.bincount(channel.repeats.astype(int)).tolist() == [0, *[EACH] * 4]
    cut = channel.slice_time(0.2, 0.5)
    rows = (channel.times >= 0.2) & (channel.times <= 0.5)
    np.testing.assert_array_equal(cut.repeats, channel.repeats[rows])
    with pytest.raises(InvalidRecord, match="need one number for each sample"):
        replace(channel, times=channel.times[:3], values=channel.values[:3])
