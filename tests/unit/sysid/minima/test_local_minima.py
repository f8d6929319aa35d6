"""Minima beside an estimate: looked for where the loss is rough, told by the intervals."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid.core.settings import GeneticAlgorithm, Stop
from sysid.core.types import FloatArray
from sysid.data.noise import Noise, draw_noise
from sysid.identification import best_estimate
from sysid.identification.conclude import conclude_run
from sysid.identification.identify import identify
from sysid.identification.run import advance_run, begin_run
from sysid.minima import local_minima
from sysid.minima.local_minima import (
    LocalMinima,
    count_affordable_simulations,
    find_local_minima,
    list_compatible_minima,
)
from sysid.minima.minima import scan_parameters
from sysid.models.catalogue.load import load_model
from sysid.models.parameters import Parameter
from sysid.search.archive import read_archive
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.estimates import Estimate
from sysid.uncertainty.intervals import compose_intervals, mark_poor_intervals
from sysid.uncertainty.linear_model import factor_covariance, linearise_outputs, make_move_generator
from tests.support.library.search_problems import COULOMB, clean, example, noisy, record

TRUTH = np.array([0.2, 0.5, 5.0, 1.0])  # of Example 1
FALSE = np.array([0.192, 0.495, 5.002, 0.485])


def rough(seed: int = 70_043) -> Problem:
    """Example 2 with dry friction: its loss jumps."""
    return Problem.build(load_model("coulomb-eq16"), [record(noisy("coulomb-eq16", seed=seed))])


def around(
    problem: Problem, start: np.ndarray, left: int | None = None, *, may_jump: bool = True
) -> LocalMinima:
    end = refine_candidates(problem, [start])[0]
    assert end is not None
    linear = analyse_estimate(problem, end.theta).linear_model
    assert linear is not None
    return find_local_minima(problem, end.theta, end.rms, linear, 1, left, may_jump=may_jump)


def test_beside_the_optimum_of_a_smooth_loss_nothing_more_than_a_look_is_spent() -> None:
    found = around(example(), np.array([0.2, 0.5, 5.0, 1.0]))
    assert found.best is None
    assert found.rms.size == 1
    assert found.evaluations == 24


@pytest.mark.parametrize("pole", [0.5, 0.9])
def test_coloured_residuals_do_not_make_a_smooth_loss_rough(pole: float) -> None:
    white = np.random.default_rng(1).normal(0.0, 0.01, 300)
    problem = Problem.build(
        load_model("duffing-eq16"), [record(clean() + lfilter([1.0], [1.0, -pole], white))]
    )
    known = analyse_estimate(problem, TRUTH).uncertainty
    assert known is not None
    assert known.noise_colour == "coloured"
    assert around(problem, TRUTH).evaluations == 24


def test_an_estimate_held_at_a_bound_does_not_make_a_smooth_loss_rough() -> None:
    narrow = {"b": {"upper": 4.9}}
    problem = Problem.build(load_model("duffing-eq16"), [record(noisy())], parameters=narrow)
    assert around(problem, np.array([0.2, 0.5, 4.9, 1.0])).evaluations == 24


@pytest.mark.parametrize(("n", "d"), [(12, 4), (30, 4), (60, 8)])
def test_few_samples_do_not_make_a_linear_regression_rough(n: int, d: int) -> None:
    class Regression:
        n_scored = n
        evaluator = SimpleNamespace(lower=np.full(d, -1e9), upper=np.full(d, 1e9))

        def evaluate_fitness(self, theta: np.ndarray) -> np.ndarray:
            return np.asarray(np.sqrt(np.mean((theta @ columns.T - measured) ** 2, axis=1)))

    for seed in range(20):
        random = np.random.default_rng(seed)
        columns, measured = random.standard_normal((n, d)), random.standard_normal(n)
        theta = np.linalg.lstsq(columns, measured, rcond=None)[0]
        error, one = columns @ theta - measured, np.ones(d)
        inverse = np.asarray(np.linalg.inv(columns.T @ columns), dtype=np.float64)
        root = np.linalg.qr(columns)[1]
        linear = linearise_outputs(error, columns, one < 0, 0.5 * one, one, one, inverse, root)
        rms = float(np.sqrt(np.mean(error**2)))
        problem: Any = Regression()
        found = find_local_minima(problem, theta, rms, linear, seed, may_jump=True)
        assert found.evaluations == 24


def test_moves_cut_off_at_bounds_are_expected_where_they_end() -> None:
    near = {"b": {"upper": 5.001}}
    problem = Problem.build(load_model("duffing-eq16"), [record(noisy())], parameters=near)
    assert around(problem, np.array([0.2, 0.5, 5.0, 1.0])).evaluations == 24


def test_the_longer_a_simulation_takes_the_fewer_are_spent() -> None:
    spent = [
        count_affordable_simulations(lasting(steps), is_late=False)
        for steps in (300, 100_000, 1_000_000)
    ]
    late = [
        count_affordable_simulations(lasting(steps), is_late=True)
        for steps in (300, 100_000, 1_000_000)
    ]
    assert spent == [1800, 500, 50]
    assert late == [1800, 50, 0]


def lasting(steps: int) -> Problem:
    """Only what is asked of a problem here."""
    grid = SimpleNamespace(points=steps // 2, substeps=2)
    return SimpleNamespace(experiments=(SimpleNamespace(grid=grid),))  # type: ignore[return-value]


def test_points_near_an_estimate_stay_inside_the_bounds() -> None:
    problem = example()
    linear = analyse_estimate(problem, TRUTH).linear_model
    assert linear is not None
    for corner in (problem.evaluator.lower, problem.evaluator.upper):
        search = local_minima._LocalSearch(problem, linear, 1, 1000)
        starts, _ = search._simulate_moves(corner, np.full(32, 3.0))
        assert np.all((starts >= problem.evaluator.lower) & (starts <= problem.evaluator.upper))
        assert np.any(starts != corner)


def test_a_run_out_of_time_says_that_it_has_not_looked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_minima, "_MAX_LATE_WORK", 0)
    problem = example()
    algorithm = GeneticAlgorithm(generations=20, stop=Stop(seconds=1e9))
    state = advance_run(problem, algorithm, begin_run(problem, algorithm, 1))
    said = "the time limit left no search for minima near the estimate"
    in_time = conclude_run(problem, algorithm, replace(state, seconds=0.0))
    late = conclude_run(problem, algorithm, replace(state, seconds=1e9))
    assert not any(said in text for text in in_time.warnings)
    assert any(said in text for text in late.warnings)
    (start,) = refine_candidates(problem, [np.array([one.value for one in late.parameters])])
    assert start is not None
    scan = scan_parameters(problem, start, [problem.free_names.index("L")], 1800).evaluations
    archived = sum(len(read_archive(island.archive)) for island in state.islands)
    assert late.evaluations == in_time.evaluations - scan - archived - 24


def test_where_on_its_plateau_a_search_ends_says_nothing_of_a_rounded_lag() -> None:
    document = load_model("duffing-eq16").document
    assert document is not None
    solver = {"history": "constant", "interpolation": "nearest"}
    model = load_model({**document, "solver": solver})
    found = []
    for seed in (1, 2, 3):
        result = identify(model, record(noisy()), seed=seed)
        found.append(next(one for one in result.parameters if one.name == "L"))
    first = found[0].interval95
    assert first is not None
    assert len({one.value for one in found}) > 1
    for one in found:
        assert one.interval95 == pytest.approx(first, abs=0.002)


def test_beside_a_minimum_of_a_rough_loss_others_are_found_inside_bounds_and_budget() -> None:
    problem = rough()
    found = around(problem, FALSE, 700)
    assert found.rms.size > 5
    assert np.unique(found.rms.round(6)).size > 1
    assert found.rms[-1] == found.rms.min()
    assert 24 < found.evaluations <= 700
    assert np.all(
        (found.values >= problem.evaluator.lower) & (found.values <= problem.evaluator.upper)
    )
    assert found.rms == pytest.approx(problem.evaluate_fitness(found.values), rel=1e-12)
    if found.best is not None:
        assert found.best.rms == found.rms.min() < found.rms[0]


def test_an_edge_is_followed_only_where_the_loss_jumps() -> None:
    jumping, bending = (around(rough(), FALSE, may_jump=jumps) for jumps in (True, False))
    assert jumping.rms[:-1].tobytes() == bending.rms.tobytes()
    assert jumping.evaluations > bending.evaluations


def test_a_search_tells_whether_the_loss_jumps(monkeypatch: pytest.MonkeyPatch) -> None:
    told = []

    def listen(*_: object, may_jump: bool, **__: object) -> LocalMinima:
        told.append(may_jump)
        return LocalMinima(None, np.zeros((1, 4)), np.zeros(1), 0)

    monkeypatch.setattr(best_estimate, "find_local_minima", listen)
    for model in ("duffing-eq16", "coulomb-eq16"):
        identify(load_model(model), record(noisy(model)), seed=1)
    unprobed = GeneticAlgorithm(generations=2)
    identify(load_model("duffing-eq16"), record(noisy()), unprobed, seed=1)
    assert told == [False, True, True]


def test_one_of_several_minima_leads_to_a_better_one() -> None:
    truth = np.array([COULOMB[name] for name in ("c", "L", "b", "mu")])
    gains = [around(rough(seed), truth).best is not None for seed in range(6)]
    assert any(gains)


def test_the_same_seed_finds_the_same_bits() -> None:
    one, other = around(rough(), FALSE, 500), around(rough(), FALSE, 500)
    assert one.values.tobytes() == other.values.tobytes()
    assert one.rms.tobytes() == other.rms.tobytes()


def test_moves_have_the_covariance_they_are_drawn_along_whatever_the_units() -> None:
    correlation = np.array([[1.0, 0.9, -0.5], [0.9, 1.0, -0.3], [-0.5, -0.3, 1.0]])
    deviation = np.array([1e-9, 1.0, 1e9])
    root = factor_covariance(correlation * np.outer(deviation, deviation)) / deviation[:, None]
    assert root @ root.T == pytest.approx(correlation, abs=1e-14)
    held = factor_covariance(np.diag([4.0, 0.0]))  # a parameter on a plateau stays
    assert held @ held.T == pytest.approx(np.diag([4.0, 0.0]), abs=1e-14)


def test_moves_are_not_made_of_the_noise_that_was_added_with_the_same_seed() -> None:
    moves = make_move_generator(1).standard_normal(50)
    for stream in (0, 1, 1000):
        assert not np.isin(moves, draw_noise(Noise(1.0, 1), 50, stream)).any()
    assert moves.tobytes() == make_move_generator(1).standard_normal(50).tobytes()


def test_without_a_budget_nothing_is_simulated() -> None:
    assert around(rough(), FALSE, 0).evaluations == 0


SAME = np.ones(1)
A = Parameter("a", 0.0, 5.0, "1")
ONE = Estimate("a", "1", 2.0, 0.0, 5.0, 0.1, (1.8, 2.2), "identified", "")


def widen(estimate: Estimate, n: int, found: LocalMinima, ratio: FloatArray = SAME) -> Estimate:
    """Widen an interval by these minima."""
    near = list_compatible_minima(("a",), n, found, ratio, np.array([2.0]))
    return compose_intervals((estimate,), near)[0]


@pytest.mark.parametrize(("ratio", "low"), [(0.0, 1.4), (2.0, 1.6 - 0.1 * np.sqrt(2)), (4.1, 1.8)])
def test_an_interval_holds_the_values_of_minima_that_the_data_do_not_rule_out(
    ratio: float, low: float
) -> None:
    n = 50
    rms = np.array([1.0, np.exp(ratio / (2 * n))])
    found = LocalMinima(None, np.array([[2.0], [1.6]]), rms, 0)
    wide = widen(ONE, n, found)
    assert wide == replace(ONE, interval95=wide.interval95)
    assert wide.interval95 == pytest.approx((low, 2.2))


def test_an_interval_that_other_minima_widen_to_much_of_the_range_says_little() -> None:
    found = LocalMinima(None, np.array([[2.0], [0.0]]), np.array([1.0, 1.0]), 0)
    (wide,) = mark_poor_intervals((A,), (widen(ONE, 50, found),))
    assert wide.status == "unidentifiable"
    assert wide.reason.endswith("its 95 % interval contains 0, and 44 % of its range")


def test_of_coloured_residuals_a_minimum_is_as_likely_as_their_variance_says() -> None:
    n, share = 50, np.array([0.25])  # standard errors twice those of white residuals
    found = LocalMinima(None, np.array([[2.0], [1.6]]), np.array([1.0, np.exp(8.0 / (2 * n))]), 0)
    white = widen(ONE, n, found)
    assert white.interval95 == pytest.approx((1.8, 2.2))
    wide = widen(ONE, n, found, share)
    assert wide.interval95 == pytest.approx((1.6 - 0.1 * np.sqrt(2.0), 2.2))


def test_the_interval_of_a_parameter_on_a_plateau_stays_around_its_middle() -> None:
    found = LocalMinima(None, np.array([[2.0], [1.6]]), np.array([1.0, 1.0]), 0)
    assert widen(ONE, 50, found, np.array([np.nan])) == ONE


def test_an_estimate_without_a_standard_error_gets_none_by_its_neighbours() -> None:
    blind = replace(ONE, stderr=None, interval95=None)
    found = LocalMinima(None, np.array([[2.0]]), np.array([1.0]), 0)
    assert widen(blind, 50, found) == blind


def test_beside_a_perfect_fit_nothing_else_is_likely() -> None:
    found = LocalMinima(None, np.array([[2.0], [1.6]]), np.array([0.0, 1e-9]), 0)
    assert widen(ONE, 50, found).interval95 == pytest.approx((1.8, 2.2))
