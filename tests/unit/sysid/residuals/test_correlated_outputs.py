"""Standard errors where two outputs are shaken by the same noise, against repetition."""

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.parse import parse_model
from sysid.residuals.sandwich import estimate_sandwich
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from tests.support.profiles import draw_seeds
from tests.support.random_bounds import bound_count, bound_mean

TIMES = 0.05 * np.arange(300.0)
TRUTH = {"a": 2.0, "b": 1.5, "T": 0.6, "L": 0.3}
MODEL = parse_model(
    {
        "name": "two",
        "form": "differential",
        "inputs": {"u": "V"},
        "states": {"x": "m"},
        "parameters": {
            "a": {"lower": 0.1, "upper": 5},
            "b": {"lower": 0.1, "upper": 5},
            "T": {"lower": 0.1, "upper": 3},
            "L": {"lower": 0, "upper": 1},
        },
        "equations": {"x": "(u(t-L) - x)/T"},
        "outputs": {"y": "a*x", "z": "b*x"},
        "initial": {"x": 0},
    }
)
U = Channel("u", TIMES, np.repeat(np.random.default_rng(7).normal(size=30), 10), hold="zero")
CLEAN = simulate(MODEL, [U], TRUTH, times=TIMES).channels


def draw_noise(seed: int, correlation: float, pole: float = 0.0) -> FloatArray:
    """Noise of two outputs (2, N), of variance 0.01 each."""
    white = np.random.default_rng(seed).standard_normal((2, TIMES.size + 100))
    white[1] = correlation * white[0] + np.sqrt(1 - correlation**2) * white[1]
    found = lfilter([0.1 * np.sqrt(1 - pole**2)], [1, -pole], white, axis=1)
    return np.asarray(found[:, 100:])


def analyse_outputs(both: FloatArray, late: int = 0) -> Analysis:
    """The analysis at the estimate; the second output is measured from sample `late` on."""
    data = [
        Channel("y", TIMES, CLEAN[0].values + both[0], "m"),
        Channel("z", TIMES[late:], (CLEAN[1].values + both[1])[late:], "m"),
    ]
    problem = Problem.build(MODEL, [Record((U,), tuple(data))], weights={"y": 1.0, "z": 1.0})
    end = refine_candidates(problem, [np.array(list(TRUTH.values()))])[0]
    assert end is not None
    return analyse_estimate(problem, end.theta)


def covers(analysis: Analysis) -> list[bool]:
    """Which intervals hold the truth."""
    found = []
    for one in analysis.estimates:
        assert one.interval95 is not None
        found.append(one.interval95[0] <= TRUTH[one.name] <= one.interval95[1])
    return found


@pytest.mark.parametrize(
    ("correlation", "pole", "gate"), [(0.9, 0.0, 150), (-0.9, 0.0, 50), (0.9, 0.7, 50)]
)
def test_intervals_cover_the_truth_whatever_outputs_have_in_common(
    correlation: float, pole: float, gate: int
) -> None:
    seeds = draw_seeds(gate=gate, night=600)
    covered = np.array(
        [covers(analyse_outputs(draw_noise(seed, correlation, pole))) for seed in seeds]
    )
    # As independent outputs 84 % of T and L for a correlation of 0.9.
    assert np.min(np.sum(covered, axis=0)) >= bound_count(len(seeds), 0.94)[0]
    shares = np.mean(covered, axis=1)
    assert np.mean(shares) >= 0.94 - bound_mean(shares)


def test_of_independent_outputs_nothing_is_taken_for_common() -> None:
    columns = np.random.default_rng(0).standard_normal((2 * TIMES.size, 4))
    data = [Channel(one.name, TIMES, one.values, "m") for one in CLEAN]
    problem = Problem.build(MODEL, [Record((U,), tuple(data))], weights={"y": 1.0, "z": 1.0})
    seeds = draw_seeds(gate=30, night=300)
    drawn = ([draw_noise(seed, one).ravel() for seed in seeds] for one in (0.0, 0.9))
    free, common = ([estimate_sandwich(problem, e, columns) is None for e in one] for one in drawn)
    assert sum(free) >= bound_count(len(seeds), 0.99)[0]
    assert not any(common)


def test_common_noise_makes_what_both_outputs_tell_less_sure() -> None:
    alone, common = (analyse_outputs(draw_noise(1, one)).estimates for one in (0.0, 0.9))
    for name in ("T", "L"):
        before, after = (next(e.stderr for e in one if e.name == name) for one in (alone, common))
        assert before is not None
        assert after is not None
        assert after / before == pytest.approx(np.sqrt(1.9), rel=0.15)


def test_only_samples_of_the_same_time_have_their_noise_in_common() -> None:
    whole, part = (analyse_outputs(draw_noise(1, 0.9), late).estimates for late in (0, 150))
    assert [e.name for e in whole] == [e.name for e in part]
    assert whole[3].stderr is not None
    assert part[3].stderr is not None
    assert part[3].stderr > 0.9 * whole[3].stderr


def test_it_is_told_as_white_noise() -> None:
    found = analyse_outputs(draw_noise(1, 0.9)).uncertainty
    assert found is not None
    assert found.noise_colour == "white"


@pytest.mark.parametrize(("correlation", "pole"), [(-0.9, 0.9), (-1.0, 0.95), (0.9, 0.95)])
def test_what_noise_leaves_of_a_difference_is_never_below_nothing(
    correlation: float, pole: float
) -> None:
    shares = []
    for seed in draw_seeds(gate=24, night=300):
        found = analyse_outputs(draw_noise(seed, correlation, pole))
        for one in found.estimates:
            assert one.stderr is not None
            assert one.stderr >= 0.0  # and a number: the difference of two spectra was below 0
        shares.append(np.mean(covers(found)))
    assert np.mean(shares) >= 0.92 - bound_mean(shares)


def test_the_same_noise_in_two_outputs_counts_once() -> None:
    columns = np.random.default_rng(0).standard_normal((2 * TIMES.size, 4))
    data = [Channel(one.name, TIMES, one.values, "m") for one in CLEAN]
    problem = Problem.build(MODEL, [Record((U,), tuple(data))], weights={"y": 1.0, "z": 1.0})
    found = estimate_sandwich(problem, draw_noise(0, 1.0).ravel(), columns)
    assert found is not None
    assert found.equivalent_samples == pytest.approx(TIMES.size)
    assert found.degrees == pytest.approx(TIMES.size - 4)


@pytest.mark.parametrize("late", [0, 40])
def test_the_middle_has_the_cross_terms_of_samples_at_the_same_times(late: int) -> None:
    n, draw = TIMES.size, np.random.default_rng(3)
    data = [Channel("y", TIMES, CLEAN[0].values, "m")]
    data += [Channel("z", TIMES[late:], CLEAN[1].values[late:], "m")]
    problem = Problem.build(MODEL, [Record((U,), tuple(data))], weights={"y": 1.0, "z": 1.0})
    first, second = draw_noise(2, 0.9)
    errors = np.concatenate([first, second[late:]])
    columns = draw.standard_normal((errors.size, 4))
    found = estimate_sandwich(problem, errors, columns)
    assert found is not None
    same = n - late  # samples of y from `late` on have the times of all of z
    cross = columns[late:n].T @ columns[n:] * (errors[late:n] @ errors[n:]) / same
    expected = np.mean(errors**2) * columns.T @ columns + cross + cross.T
    np.testing.assert_allclose(found.middle, expected)
    correlation = (errors[late:n] @ errors[n:]) / np.sqrt(
        (errors[late:n] @ errors[late:n]) * (errors[n:] @ errors[n:])
    )
    independent = errors.size**2 / (errors.size + 2 * same * correlation**2)
    assert found.equivalent_samples == pytest.approx(independent)
