"""Minima that one search misses, and minima that the data do not tell apart."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.traps import CHATTER, periodic_input
from sysid import Channel, GeneticAlgorithm, Identification, Record, identify, load_model
from sysid.core.settings import Loss, SearchMethod
from sysid.core.types import FloatArray
from sysid.identification.conclude import conclude_run
from sysid.identification.run import advance_run, begin_run
from sysid.minima.minima import (
    Fit,
    FoundMinima,
    collect_minima,
    mark_ambiguous,
    scan_parameters,
)
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.search.archive import archive_end, make_archive
from sysid.search.refine import RefinedCandidate, refine_candidates
from sysid.search.state import Improvement
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import to_unit
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.linear_model import LinearOutputModel
from tests.support.library import search_problems

STEP, GAIN, TIME, LAG, PERIOD = 0.2, 2.0, 1.5, 1.33, 5.0
FINE = 40
NOISE = 0.02


def lag_model() -> Model:
    return parse_model(
        {
            "name": "lag",
            "form": "differential",
            "inputs": {"u": "V"},
            "states": {"x": "V"},
            "parameters": {
                "K": {"lower": 0, "upper": 10, "unit": "1"},
                "T": {"lower": 0.05, "upper": 10, "unit": "s"},
                "L": {"lower": 0, "upper": 12, "unit": "s"},
            },
            "equations": {"x": "(K*u(t - L) - x)/T"},
            "outputs": {"y": "x"},
            "initial": {"x": {"lower": -5, "upper": 5}},
        }
    )


def respond(u: FloatArray) -> FloatArray:
    """The response to a held input, from rest at its first value, exact between jumps."""
    grid = np.arange((u.size - 1) * FINE + 1) * STEP / FINE
    driven = GAIN * u[np.clip(np.floor((grid - LAG) / STEP + 1e-9).astype(int), 0, u.size - 1)]
    pole, x, out = np.exp(-STEP / FINE / TIME), driven[0], np.empty(grid.size)
    for k in range(grid.size):
        out[k] = x
        x = pole * x + (1 - pole) * driven[k]
    return out[::FINE]


def periodic(count: int = 300) -> FloatArray:
    return np.where(np.round(np.arange(count) * STEP, 6) % PERIOD < 2.0, 1.0, -0.5)


def make_steps(count: int = 300) -> FloatArray:
    random = np.random.default_rng(4)
    return np.repeat(random.uniform(-1, 1, count // 6 + 1), 6)[:count]


def make_record(u: FloatArray, first: int, seed: int = 1) -> Record:
    """The part of a longer recording that begins at sample `first`."""
    y = respond(u) + NOISE * np.random.default_rng(seed).standard_normal(u.size)
    times = np.arange(u.size - first) * STEP
    return Record(
        (Channel("u", times, u[first:], "V", hold="zero"),), (Channel("y", times, y[first:], "V"),)
    )


def find_status(found: Identification, name: str) -> str:
    return next(one.status for one in found.parameters if one.name == name)


def find_reason(found: Identification, name: str) -> str:
    return next(one.reason for one in found.parameters if one.name == name)


def regenerate() -> tuple[Problem, FloatArray]:
    """A noisy record of the model of chatter, and the truth."""
    model = parse_model(CHATTER)
    near = {"ze": {"fixed": 0.05}, "om": {"upper": 60}, "kc": {"upper": 60}, "tau": {"upper": 9}}
    times = np.arange(400) * 0.05
    force = np.where((times % 7 < 0.5), 20.0, 0.0)
    clean = Record((Channel("u", times, force, "N"),), (Channel("y", times, 0 * times, "m"),))
    truth = np.array([6.0, 8.0, 1.9])
    y = Problem.build(model, [clean], parameters=near).predict(truth[None])[0]
    y = y + 0.02 * np.std(y) * np.random.default_rng(2).standard_normal(y.size)
    measured = Record(clean.inputs, (Channel("y", times, y, "m"),))
    return Problem.build(model, [measured], parameters=near), truth


def test_a_scan_of_the_lag_leads_out_of_a_false_minimum() -> None:
    problem, truth = regenerate()
    (false,) = refine_candidates(problem, [np.array([6.0, 8.0, 2.95])])
    assert false is not None
    (best,) = refine_candidates(problem, [truth])
    assert best is not None
    assert false.rms > 1.5 * best.rms
    found = scan_parameters(problem, false, [2], 2000)
    assert found.best.rms == pytest.approx(best.rms, rel=1e-6)
    assert found.best.theta == pytest.approx(best.theta, rel=1e-3)
    assert found.evaluations <= 1000


def test_a_scan_keeps_its_budget_and_its_start() -> None:
    problem = Problem.build(lag_model(), [make_record(make_steps(), 0)])
    start = RefinedCandidate(np.array([2.0, 1.5, 4.0, 0.0]), 1.0, 0)
    for budget in (0, 10, 150, 200):
        found = scan_parameters(problem, start, [2], budget)
        assert found.evaluations <= budget
        assert found.ends[0] is start


def test_lags_a_period_apart_are_listed_where_the_start_is_skipped() -> None:
    found = identify(lag_model(), make_record(periodic(500), 200), skip=120, seed=3)
    assert find_status(found, "L") == "ambiguous"
    lags = sorted(one.values[2] for one in found.search.minima if one.is_compatible)
    assert lags == pytest.approx([LAG, LAG + PERIOD, LAG + 2 * PERIOD], abs=0.02)
    (own,) = (one.value for one in found.parameters if one.name == "L")
    others = [lag for lag in lags if abs(lag - own) > 1]
    assert list_told(found) == pytest.approx(others, abs=0.01)
    assert {find_status(found, name) for name in "KT"} == {"identified"}


@pytest.fixture(scope="module")
def wrongly_assumed() -> Identification:
    """A periodic input whose values before the record are assumed wrongly."""
    return identify(lag_model(), make_record(periodic(500), 200), seed=3)


def test_lags_a_period_apart_are_listed_though_an_assumed_input_tells_them_apart(
    wrongly_assumed: Identification,
) -> None:
    assert find_status(wrongly_assumed, "L") == "ambiguous"
    assert "where the input is recorded" in find_reason(wrongly_assumed, "L")
    told = "Its first value is assumed there, and the data contradict it."
    assert sum(told in text for text in wrongly_assumed.warnings) == 1
    compared = [one for one in wrongly_assumed.search.minima if one.recorded_from is not None]
    assert len([one for one in compared if one.is_compatible]) == 3
    assert list_told(wrongly_assumed) == pytest.approx([LAG + PERIOD, LAG + 2 * PERIOD], abs=0.05)


def test_an_assumed_input_is_told_once(wrongly_assumed: Identification) -> None:
    assert sum("assumed" in text for text in wrongly_assumed.warnings) == 1


def test_an_assumed_input_is_no_noise(wrongly_assumed: Identification) -> None:
    assert wrongly_assumed.noise_model == "white"


def test_lags_a_period_apart_are_listed_though_few_samples_are_skipped() -> None:
    """The skipped samples alone could tell whether the input before the record was the first."""
    found = identify(lag_model(), make_record(periodic(500), 200), skip=40, seed=3)
    assert find_status(found, "L") == "ambiguous"
    assert list_told(found) == pytest.approx([LAG + PERIOD, LAG + 2 * PERIOD], abs=0.05)
    assert not any("contradict" in text for text in found.warnings)


def test_a_lag_that_the_assumed_input_has_moved_is_told_with_its_value_without() -> None:
    draw = periodic_input(np.random.default_rng(62_001))
    found = identify(draw.model, draw.record, seed=1, loss=Loss(noise_model="white"))
    (own,) = (one for one in found.parameters if one.name == "L")
    assert own.stderr is not None
    assert abs(own.value - draw.truth) > 2.0 * own.stderr
    lags = [draw.truth + k * draw.period for k in range(3)]
    assert list_told(found) == pytest.approx(lags, abs=0.05)


def list_told(found: Identification) -> list[float]:
    """The time lags (s) that the result names beside its own."""
    return sorted(float(text) for text in find_reason(found, "L").split(" s ")[0].split(", "))


def test_a_noise_model_does_not_hide_that_the_data_contradict_the_assumed_input() -> None:
    loss = Loss(noise_model="ar1")
    found = identify(lag_model(), make_record(periodic(500), 200), seed=3, loss=loss)
    assert found.noise_model == "ar1"
    assert find_status(found, "L") == "ambiguous"
    assert any("and the data contradict it" in text for text in found.warnings)


def test_a_record_that_begins_at_rest_tells_lags_a_period_apart() -> None:
    found = identify(lag_model(), make_record(np.concatenate([np.full(40, -0.5), periodic()]), 0))
    assert find_status(found, "L") == "identified"
    assert not any("contradict" in text for text in found.warnings)


@pytest.mark.parametrize("skip", [0, 40])
def test_an_input_without_a_period_tells_the_lag(skip: int) -> None:
    found = identify(lag_model(), make_record(make_steps(500), 200), skip=skip)
    assert find_status(found, "L") == "identified"
    (own,) = (one for one in found.parameters if one.name == "L")
    assert own.stderr is not None
    assert abs(own.value - LAG) <= 4 * own.stderr + 0.1


def test_a_search_that_ends_too_early_says_that_it_did_not_settle() -> None:
    hurried = GeneticAlgorithm(generations=1, islands=1, refine=False)
    found = identify(load_model("duffing-eq16"), _duffing_record(), hurried)
    assert not found.search.settled
    assert found.search.because is None
    assert "identified" not in {one.status for one in found.parameters}
    assert any(text.startswith("the search did not settle") for text in found.warnings)


def test_a_search_is_settled_by_starts_that_agree_or_by_residuals_that_are_noise() -> None:
    agreed = identify(load_model("duffing-eq16"), _duffing_record())
    assert agreed.search.settled
    assert agreed.search.because == "starts"
    assert 2 <= agreed.search.agreeing_starts <= agreed.search.independent_starts
    hurried = GeneticAlgorithm(generations=20, islands=1)
    quick = identify(load_model("duffing-eq16"), _duffing_record(), hurried)
    assert quick.search.agreeing_starts < 2
    assert quick.search.because == "residuals"
    assert {one.status for one in quick.parameters} == {"identified"}


def test_starts_count_only_if_they_ended_in_the_minimum_of_the_result() -> None:
    problem, truth = regenerate()
    search = GeneticAlgorithm(generations=20, islands=2)
    state = advance_run(problem, search, begin_run(problem, search, 1))
    (false,) = refine_candidates(problem, [np.array([6.0, 8.0, 2.95])])
    assert false is not None
    (rms,) = problem.evaluate_fitness(truth[None])
    for first, agreeing in ((truth, 6), (false.theta, 3)):
        islands = []
        champions = ((first, 0.99 * rms), (truth, rms))
        for island, (place, rms) in zip(state.islands, champions, strict=True):
            archive = make_archive(place.size)
            for _ in range(3):
                archive_end(archive, to_unit(problem.evaluator, place[None])[0], rms)
            champion = Improvement(20, 100, rms, "sequence", tuple(place.tolist()))
            islands.append(replace(island, archive=archive, history=(champion,)))
        found = conclude_run(problem, search, replace(state, islands=tuple(islands)))
        assert found.search.agreeing_starts == agreeing
        assert {one.name: one.value for one in found.parameters}["tau"] == pytest.approx(
            truth[2], rel=1e-2
        )


@pytest.mark.parametrize("method", ["simple", "improved-paper"])
def test_champions_that_are_not_refined_are_no_minima(method: SearchMethod) -> None:
    search = GeneticAlgorithm(method=method, generations=5, islands=2)
    assert identify(load_model("duffing-eq16"), _duffing_record(), search).search.minima == ()


def _duffing_record() -> Record:
    return search_problems.record(search_problems.noisy(seed=5))


def test_equal_ends_are_one_minimum_and_ratios_are_of_likelihoods() -> None:
    problem = Problem.build(lag_model(), [make_record(make_steps(), 0)])
    ends = [
        Fit(np.array([2.0, 1.5, 1.33, 0.0]), 0.02),
        Fit(np.array([2.001, 1.501, 1.331, 0.001]), 0.02, 4, 3),
        Fit(np.array([2.0, 1.5, 6.33, 0.0]), 0.021),
    ]
    first, second = collect_minima(problem, ends)
    assert (first.count, first.independent, second.count) == (5, 3, 1)
    assert first.likelihood_ratio == 0.0
    assert second.likelihood_ratio == pytest.approx(2 * 300 * np.log(1.05))
    assert not second.is_compatible
    sharp = LinearOutputModel(
        np.eye(4), 1e3 * np.eye(4), np.zeros(4), 300 * 0.02**2, np.full(4, 0.1)
    )
    assert collect_minima(problem, ends, sharp)[1].is_compatible
    assert collect_minima(problem, []) == ()  # no end reads recorded input only


def test_ends_in_one_flat_valley_are_one_minimum() -> None:
    """Least squares ends anywhere along what the data leave open, here K and T together."""
    problem = Problem.build(lag_model(), [make_record(make_steps(), 0)])
    best = np.array([2.0, 1.5, 1.33, 0.0])
    along, across = best.copy(), best.copy()
    along[:2] += 0.5
    across[:2] += 0.5, -0.5
    fits = [Fit(best, 0.02), Fit(along, 0.02001, 3, 3), Fit(across, 0.02001)]
    root = 20.0 * np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])

    def collect_counts(ratio: float) -> list[tuple[int, int]]:
        flat = LinearOutputModel(
            np.eye(4), root, np.zeros(4), 300 * 0.02**2, np.array([1.0, ratio, 1.0, 1.0])
        )
        return [(one.count, one.independent) for one in collect_minima(problem, fits, flat)]

    assert collect_counts(1.0) == [(4, 3), (1, 0)]
    assert collect_counts(np.nan) == [(1, 0), (3, 3), (1, 0)]  # T is not in the linear model
    assert len(collect_minima(problem, fits)) == 3


def test_an_estimate_that_a_noise_model_moved_is_not_ambiguous_for_it() -> None:
    problem = Problem.build(lag_model(), [make_record(make_steps(), 0)])
    names = problem.free_names
    white, moved, far = (
        np.array([2.0, 1.5, 1.33, 0.0]),
        np.array([2.2, 1.5, 1.33, 0.0]),
        np.array([2.0, 1.5, 6.33, 0.0]),
    )
    estimates = tuple(
        Estimate(name, "1", value, -10.0, 20.0, 0.01, (value - 0.02, value + 0.02), "identified")
        for name, value in zip(names, moved.tolist(), strict=True)
    )
    ruled_out = np.array([2.21, 1.5, 1.33, 0.0])  # nearer to the estimate, but no better for it
    fits = [Fit(white, 0.02), Fit(far, 0.0200001), Fit(ruled_out, 0.05)]
    minima = collect_minima(problem, fits)
    marked = mark_ambiguous(problem, estimates, FoundMinima(minima, 0))
    assert [one.status for one in marked] == [
        "identified",
        "identified",
        "ambiguous",
        "identified",
    ]
