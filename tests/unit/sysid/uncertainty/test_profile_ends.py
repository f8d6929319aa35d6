"""Ends of intervals by the profile: against fits of the others, open ones, and sets."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Hold, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.residuals.series import make_whitening
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import Analysis, analyse_estimate
from sysid.uncertainty.estimates import AT_LIMIT, Estimate
from sysid.uncertainty.intervals import ProfileEnds, compose_intervals
from sysid.uncertainty.profile_ends import FoundEnds, extrapolate_ends, find_profile_ends
from tests.support.library.small_models import LINE

PLENTY = 10_000
DECAY: dict[str, Any] = {
    "name": "decay",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {
        "A": {"lower": 0.1, "upper": 60.0},
        "T": {"lower": 0.05, "upper": 50.0},
    },
    "equations": {"x": "-x/T"},
    "outputs": {"y": "A - A*x + 0*u"},
    "initial": {"x": 1},
    "solver": {"substeps": 2},
}
GAIN: dict[str, Any] = {
    "name": "gain",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {"K": {"lower": 0.1, "upper": 10}, "L": {"lower": 0, "upper": 15, "unit": "s"}},
    "equations": {"x": "-x"},
    "outputs": {"y": "K*u(t - L) + x"},
    "initial": {"x": 0},
}


def solve(
    model: dict[str, Any], u: FloatArray, y: FloatArray, step: float, *start: float
) -> tuple[Problem, FloatArray]:
    """Fit a model to a record with a held input; return the problem and the estimate."""
    problem = Problem.build(parse_model(model), [record(u, y, step)])
    end = refine_candidates(problem, [np.array(start)])[0]
    assert end is not None
    return problem, end.theta


def record(u: FloatArray, y: FloatArray, step: float, hold: Hold = "zero") -> Record:
    times = step * np.arange(u.size)
    return Record((Channel("u", times, u, hold=hold),), (Channel("y", times, y),))


def solve_decay(end: float, noise: float = 0.05, seed: int = 1) -> tuple[Problem, FloatArray]:
    """A step response of the time constant 4 up to a time: the shorter, the less linear."""
    times = 0.1 * np.arange(round(end / 0.1))
    y = 2.0 - 2.0 * np.exp(-times / 4.0)
    y += noise * np.random.default_rng(seed).standard_normal(times.size)
    return solve(DECAY, np.ones(times.size), y, 0.1, 2.0, 4.0)


def find(problem: Problem, theta: FloatArray, most: int = PLENTY) -> tuple[FoundEnds, Analysis]:
    analysis = analyse_estimate(problem, theta)
    return find_profile_ends(problem, theta, analysis, most), analysis


def compute_fixed_ratio(problem: Problem, theta: FloatArray, name: str, value: float) -> float:
    """The likelihood ratio of a fit of the others, with white noise: (n - D)(R/R0 - 1)."""
    d = problem.free_names.index(name)
    fixed = problem.rebuild(parameters={name: {"fixed": value}})
    (end,) = refine_candidates(fixed, [np.delete(theta, d)])
    assert end is not None
    least = float(problem.evaluate_fitness(theta[None])[0])
    return (problem.n_scored - theta.size) * ((end.rms / least) ** 2 - 1.0)


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_at_the_ends_a_fit_of_the_others_is_as_unlikely_as_the_quantile_says(seed: int) -> None:
    problem, theta = solve_decay(6.0, seed=seed)
    found, analysis = find(problem, theta)
    assert analysis.likelihood is not None
    assert set(found.by_name) == {"A", "T"}  # their correlation is above 0.95
    for name, ends in found.by_name.items():
        assert ends.is_closed
        quantile = analysis.likelihood.quantiles[problem.free_names.index(name)]
        for value in ends.interval:
            ratio = compute_fixed_ratio(problem, theta, name, value)
            assert np.sqrt(ratio) == pytest.approx(quantile, rel=0.03)


def test_a_curved_valley_reaches_further_on_its_flat_side() -> None:
    problem, theta = solve_decay(5.0)
    ends = find(problem, theta)[0].by_name["T"]
    low, high = ends.interval
    assert high - theta[1] > 1.2 * (theta[1] - low)


def test_a_record_that_ends_too_early_leaves_gain_and_time_constant_open_above() -> None:
    problem, theta = solve_decay(1.0)
    found, analysis = find(problem, theta)
    gain, time = compose_intervals(analysis.estimates, found.by_name)
    assert time.interval95 is not None
    assert time.interval95[1] == time.upper
    assert time.reason.endswith("up to its bound 50 fit")
    assert gain.reason.endswith("fit, where T meets its bound")  # both grow together
    for one in (gain, time):
        assert (one.status, one.open_ends) == ("unidentifiable", ("upper",))


def test_an_end_at_a_physical_limit_is_closed_also_where_another_parameter_meets_it() -> None:
    searched, theta = solve_decay(1.0)
    problem = searched.rebuild(parameters={"T": {"physical": "upper"}})
    found, analysis = find(problem, theta)
    assert all(ends.is_closed and ends.meets_limit for ends in found.by_name.values())
    gain, time = compose_intervals(analysis.estimates, found.by_name)
    assert time.interval95 is not None
    assert time.interval95[1] == time.upper
    for one in (gain, time):
        assert (one.status, one.open_ends, one.reason) == ("identified", (), "")
    below = searched.rebuild(parameters={"T": {"physical": "lower"}})
    assert {*find(below, theta)[0].by_name["T"].limits} == {"upper"}


@pytest.mark.parametrize("pole", [0.0, 0.7])
def test_of_a_linear_model_both_intervals_are_the_same(pole: float) -> None:
    """The slope and the offset are correlated, so they are profiled; AR(1) noise is whitened."""
    rng = np.random.default_rng(3)
    n = 120
    u = 3.0 + 0.1 * rng.standard_normal(n)
    noise = rng.standard_normal(n)
    for k in range(1, n):
        noise[k] += pole * noise[k - 1]
    problem, theta = solve(LINE, u, 2.0 * u + 1.0 + 0.1 * noise, 0.1, 2.0, 1.0)
    white = make_whitening(problem, {"y": 0.25}) if pole else None
    analysis = analyse_estimate(problem, theta, None, *filter(None, [white]))
    if white is not None:  # at the optimum of whitened squares
        basis = white.whiten(np.column_stack([u, np.ones(n)]).T).T
        solution = np.linalg.lstsq(basis, white.whiten(problem.records[0].outputs[0].values))[0]
        theta = np.asarray(solution)
        analysis = analyse_estimate(problem, theta, None, white)
    found = find_profile_ends(problem, theta, analysis, PLENTY)
    assert set(found.by_name) == {"a", "b"}
    for estimate in analysis.estimates:
        assert found.by_name[estimate.name].interval == pytest.approx(estimate.interval95, rel=2e-3)


def test_of_a_linear_model_without_correlation_nothing_is_profiled() -> None:
    rng = np.random.default_rng(4)
    u = rng.standard_normal(200)
    problem, theta = solve(LINE, u, 2.0 * u + 0.1 * rng.standard_normal(200), 0.1, 2.0, 0.0)
    found, _ = find(problem, theta)
    assert found.by_name == {}
    assert found.evaluations <= 1 + 3 + 4  # the slopes, and both ends of both intervals


def test_outliers_weigh_in_the_profile_as_in_the_loss() -> None:
    rng = np.random.default_rng(8)
    u = 3.0 + 0.3 * rng.standard_normal(150)
    y = 2.0 * u + 1.0 + 0.1 * rng.standard_normal(150)
    y[::15] += 2.0
    times = 0.1 * np.arange(150)
    data = Record((Channel("u", times, u, hold="zero"),), (Channel("y", times, y),))
    problem = Problem.build(parse_model(LINE), [data], loss=Loss(kind="soft-l1", scale=0.1))
    end = refine_candidates(problem, [np.array([2.0, 1.0])])[0]
    assert end is not None
    found, analysis = find(problem, end.theta)
    for estimate in analysis.estimates:
        assert estimate.interval95 is not None
        width = np.ptp(estimate.interval95)
        assert np.ptp(found.by_name[estimate.name].interval) == pytest.approx(width, rel=0.1)


def test_a_small_budget_leaves_the_local_intervals() -> None:
    problem, theta = solve_decay(6.0)
    for most in (0, 7, 12, 30):
        found, _ = find(problem, theta, most)
        assert found.by_name == {}
        assert found.evaluations <= most


def test_the_simulations_to_both_ends_are_few_dozens() -> None:
    problem, theta = solve_decay(6.0)
    found, _ = find(problem, theta)
    assert found.evaluations < 2 * 100


def test_a_record_without_noise_has_no_profile() -> None:
    problem, theta = solve_decay(6.0, noise=0.0)
    assert find(problem, theta)[0].by_name == {}


def make_static_record(lag: float, noise: float, hold: Hold = "zero") -> Record:
    """A held input, and its output a lag later without any dynamics; both sampled each second."""
    rng = np.random.default_rng(6)
    u = np.repeat(rng.integers(0, 2, 20), 4).astype(np.float64)
    late = np.floor(np.arange(u.size) - lag + 1e-9).astype(int)
    y = 2.0 * u[np.maximum(late, 0)] * (late >= 0)
    return record(u, y + noise * rng.standard_normal(u.size), 1.0, hold)


def get_lag(model: Model, data: Record, **options: Any) -> Estimate:
    return identify(model, data, **options)["L"]


@pytest.mark.parametrize("lag", [9.05, 9.75])
def test_a_lag_that_moves_the_output_at_whole_samples_only_lies_between_two(lag: float) -> None:
    found = get_lag(parse_model(GAIN), make_static_record(lag, 0.05))
    assert found.interval95 == pytest.approx((9.0, 10.0), abs=0.01)
    assert found.stderr == pytest.approx(1.0 / np.sqrt(12.0), rel=0.02)
    assert (found.status, found.open_ends) == ("identified", ())
    assert found.reason == "it lies between 9.00 s and 10.00 s, where all values fit alike"


def test_a_rounded_lag_lies_between_the_ends_of_its_plateau() -> None:
    rounded = parse_model({**GAIN, "solver": {"interpolation": "nearest"}})
    found = get_lag(rounded, make_static_record(9.0, 0.05))
    assert found.interval95 is not None
    assert np.ptp(found.interval95) == pytest.approx(1.0, abs=0.02)


def test_in_noise_a_lag_lies_among_several_samples() -> None:
    found = get_lag(parse_model(GAIN), make_static_record(9.5, 4.0))
    assert found.interval95 is not None
    low, high = found.interval95
    assert low <= 9.5 <= high
    assert high - low > 1.5


def test_a_run_of_a_sweep_keeps_the_local_interval() -> None:
    times = 0.5 * np.arange(47)
    u = np.where(times < 15.0, 2.0, 7.0)
    rise = np.maximum(times - 18.85, 0.0)
    y = 28.5 + 2.0 * 2.0 + 2.0 * 5.0 * (1.0 - np.exp(-rise / 8.37))
    data = record(u, y + 0.09 * np.random.default_rng(4).standard_normal(47), 0.5)
    model = load_model("fopdt")
    profiled, local = (
        identify(model, data, initial="rest", compare_orders=orders) for orders in (True, False)
    )
    assert {one.open_ends for one in local.parameters} == {()}
    for name in ("K", "T"):
        one, other = profiled[name], local[name]
        assert one.interval95 is not None
        assert other.interval95 is not None
        assert one.value == other.value
        assert one.interval95[1] > other.interval95[1]
        assert one.interval95[0] > 0.0


def test_the_ends_of_a_set_follow_from_two_steps_unless_it_shrinks() -> None:
    coarse = ProfileEnds((9.25, 9.75), is_set=True)
    fine = ProfileEnds((9.125, 9.875), is_set=True)
    assert extrapolate_ends(coarse, fine) == replace(coarse, interval=(9.0, 10.0))
    assert extrapolate_ends(fine, coarse) == fine


def test_a_closed_profile_identifies_what_the_linear_model_does_not() -> None:
    vague = Estimate("L", "s", 9.0, 0.0, 15.0, 20.0, (-31.0, 49.0), "unidentifiable", "its error")
    (found,) = compose_intervals([vague], {"L": ProfileEnds((8.5, 9.5))})
    assert (found.status, found.reason, found.interval95) == ("identified", "", (8.5, 9.5))
    assert found.stderr == pytest.approx(1.0 / np.sqrt(12.0))
    (kept,) = compose_intervals([vague], {"L": ProfileEnds((8.5, 15.0), is_closed=False)})
    assert (kept.status, kept.stderr, kept.interval95) == ("unidentifiable", 20.0, (8.5, 15.0))


def test_a_closed_profile_shows_that_there_is_no_combination_beside_a_limit_alone() -> None:
    member = Estimate("r", "1", 1.0, 0.05, 1.0, None, None, "group", "only a combination")
    beside = ProfileEnds((0.8, 1.0), meets_limit=True)
    (found,) = compose_intervals([member], {"r": beside})
    assert (found.status, found.reason, found.interval95) == ("identified", AT_LIMIT, (0.8, 1.0))
    assert found.stderr == pytest.approx(0.2 / np.sqrt(12.0))
    for ends in (replace(beside, meets_limit=False), replace(beside, is_closed=False)):
        (kept,) = compose_intervals([member], {"r": ends})
        assert (kept.status, kept.stderr) == ("group", None)


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ({"upper": "L"}, "open above: all values from 1 s up to its bound 5 s fit"),
        ({"lower": "L"}, "open below: all values from 5 s down to its bound 1 s fit"),
        ({"upper": "K"}, "open above: all values from 1 s up to 5 s fit, where K meets"),
        (
            {"lower": "L", "upper": "K"},
            "open below and above: all values from 1 s to 5 s fit",
        ),
    ],
)
def test_an_open_end_is_explained(limits: dict[Any, str], reason: str) -> None:
    one = Estimate("L", "s", 2.0, 0.0, 5.0, 0.5, (1.0, 3.0), "identified")
    (found,) = compose_intervals([one], {"L": ProfileEnds((1.0, 5.0), limits, is_closed=False)})
    # Towards 0 it is still known how large it may be.
    assert found.status == ("unidentifiable" if "upper" in limits else "identified")
    assert found.open_ends == tuple(limits)
    assert found.reason.startswith(reason)
