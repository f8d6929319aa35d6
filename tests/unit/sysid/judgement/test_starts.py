"""Starts are compared on the same samples, and the open ones are found."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import FitSettings, InitialSetting
from sysid.data.records import Channel, Record
from sysid.judgement.starts import StartComparison, compare_starts, find_open_starts
from sysid.models.catalogue.load import load_model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.start_values import convert_point, list_starts, starts_at_rest
from sysid.uncertainty.analysis import analyse_estimate

N = 200
TIMES = np.arange(float(N))
STEP = np.where(TIMES >= 3.0, 1.0, 0.0)
TRUTH = {"K": 2.0, "T": 12.0, "L": 5.0, "y0": 20.0, "x(0)": 0.0}


def make_problem(
    x0: float, model: str = "fopdt", initial: InitialSetting | None = None, noise: float = 0.05
) -> Problem:
    after = np.maximum(TIMES - 8.0, 0.0)
    y = 20.0 + 2.0 * (1.0 - np.exp(-after / 12.0)) + x0 * np.exp(-TIMES / 12.0)
    y = y + noise * np.random.default_rng(4).standard_normal(N)
    record = Record((Channel("u", TIMES, STEP, hold="zero"),), (Channel("y", TIMES, y),))
    return Problem.from_settings(load_model(model), [record], FitSettings(initial=initial))


def fit(problem: Problem) -> np.ndarray:
    start = np.array([TRUTH[name] for name in problem.free_names])
    (end,) = refine_candidates(problem, [start])
    assert end is not None
    return end.theta


def compare(problem: Problem) -> StartComparison:
    comparison = compare_starts(problem, fit(problem))
    assert comparison is not None
    return comparison


def test_a_plant_at_rest_needs_no_start() -> None:
    comparison = compare(make_problem(0.0))
    assert [one.name for one in comparison.fits] == ["free", "rest"]
    best = comparison.best
    assert best.name == "rest"
    assert best.stderrs["K"] < 0.5 * comparison.own.stderrs["K"]
    assert best.values["K"] == pytest.approx(2.0, abs=3 * best.stderrs["K"])
    assert comparison.evaluations < 2000


def test_nothing_speaks_for_a_start_that_explains_no_more() -> None:
    comparison = compare(make_problem(0.0))
    rested = comparison.take(comparison.best)
    assert not comparison.own.is_open
    estimates = analyse_estimate(rested.own.problem, rested.own.theta).estimates
    assert list(find_open_starts(rested, estimates)) == []


def test_an_open_start_that_moves_an_estimate_is_found() -> None:
    comparison = compare(make_problem(0.0))
    rested = comparison.take(comparison.best)
    free = replace(rested.fits[1], is_open=True)
    estimates = analyse_estimate(rested.own.problem, rested.own.theta).estimates
    [note] = find_open_starts(replace(rested, fits=(rested.own, free)), estimates)
    assert (note.severity, note.parameters) == ("note", ())
    likely = replace(free, criteria=rested.own.criteria)
    [found] = find_open_starts(replace(rested, fits=(rested.own, likely)), estimates)
    assert found.severity == "caution"
    assert "(initial: free)" in found.text
    assert set(found.parameters) <= {"K", "T", "L", "y0"}
    assert note.gain == pytest.approx(rested.own.bic - free.bic)
    assert found.gain == 0.0
    assert abs(found.moves[0].stderrs) > 1.0


def test_a_record_amid_a_motion_rules_a_rest_out() -> None:
    comparison = compare(make_problem(1.0))
    assert comparison.best.name == "free"
    assert [one.is_open for one in comparison.fits] == [True, False]


def test_a_start_is_compared_from_either_side() -> None:
    free = make_problem(0.0)
    rest = free.rebuild(initial="rest")
    names = [one.name for one in compare(rest).fits]
    assert names == ["rest", "free"]
    assert compare(rest).best.bic == pytest.approx(compare(free).best.bic, rel=1e-6)


@pytest.mark.parametrize("initial", ["rest", "free"])
def test_a_given_start_is_left_alone(initial: InitialSetting) -> None:
    problem = make_problem(0.0, initial=initial)
    assert compare_starts(problem, fit(problem), initial) is None


def test_starts_are_compared_only_where_likelihoods_are() -> None:
    problem = make_problem(0.0)
    theta = fit(problem)
    one_step = problem.rebuild(prediction="one-step")
    bounded = problem.rebuild(parameters={"x(0)": {"lower": -9.0}})
    assert compare_starts(one_step, theta) is None
    assert compare_starts(bounded, theta) is None
    assert compare_starts(problem, theta, None) is not None  # the document says auto
    assert compare_starts(problem, theta, max_simulations=100) is None
    assert compare_starts(problem, theta, is_late=lambda: True) is None


def test_a_point_moves_to_another_start_at_the_same_values() -> None:
    free = make_problem(0.0)
    theta = np.array([2.0, 12.0, 5.0, 20.0, 0.7])
    rest = free.rebuild(initial="rest")
    assert list_starts(free, theta) == {"x(0)": 0.7}
    assert convert_point(free, rest, theta).tolist() == [2.0, 12.0, 5.0, 20.0]
    assert list_starts(rest, theta[:4]) == {"x(0)": 0.0}
    assert convert_point(rest, free, theta[:4]).tolist() == [2.0, 12.0, 5.0, 20.0, 0.0]


def test_a_fixed_start_may_be_a_rest() -> None:
    problem = make_problem(0.0)
    theta = np.array([2.0, 12.0, 5.0, 20.0])
    assert starts_at_rest(problem.rebuild(initial="rest"), theta)
    assert starts_at_rest(problem.rebuild(parameters={"x(0)": {"fixed": 0.0}}), theta)
    assert not starts_at_rest(problem.rebuild(parameters={"x(0)": {"fixed": 0.5}}), theta)
    assert not starts_at_rest(problem, np.array([*theta, 0.0]))


def test_a_lag_at_its_upper_bound_explains_nothing() -> None:
    """Behind half a record of lag, a free transient takes the place of the answer to a step."""
    early, late = (np.maximum(TIMES - begin, 0.0) for begin in (1.0, 130.0))
    y = 20.0 + 2.0 * (1.0 - np.exp(-early / 12.0)) + 0.4 * (1.0 - np.exp(-late / 12.0))
    y = y + 0.05 * np.random.default_rng(1).standard_normal(N)
    step = Channel("u", TIMES, np.where(TIMES >= 1.0, 1.0, 0.0), hold="zero")
    problem = Problem.build(load_model("fopdt"), [Record((step,), (Channel("y", TIMES, y),))])
    lag = problem.evaluator.upper[problem.free_names.index("L")]
    comparison = compare_starts(problem, np.array([0.2, 12.0, lag, 22.0, -2.0]))
    assert comparison is not None
    free, rest = comparison.fits
    assert free.values["L"] == lag
    assert free.bic < rest.bic
    assert [free.is_open, rest.is_open] == [False, True]
    assert comparison.best is rest


def test_a_false_minimum_of_the_estimate_decides_no_start() -> None:
    """Only the scan of a rest leaves it. So the other start is fitted from there as well."""
    random = np.random.default_rng(1)
    u = np.repeat(random.choice([-1.0, 1.0], N // 5), 5)
    record = Record((Channel("u", TIMES, u, hold="zero"),), (Channel("y", TIMES, TIMES),))
    truth = Problem.from_settings(load_model("fopdt"), [record], FitSettings(initial="free"))
    true_values = {"K": 2.0, "T": 4.0, "L": 3.0, "y0": 0.0, "x(0)": 5.0}
    y = truth.predict(np.array([[true_values[name] for name in truth.free_names]]))[0]
    y = y + 0.1 * random.standard_normal(N)
    measured = replace(record, outputs=(Channel("y", TIMES, y),))
    problem = Problem.from_settings(load_model("fopdt"), [measured], FitSettings())
    false = {"K": -0.4, "T": 4.0, "L": 60.0, "y0": 0.0, "x(0)": 5.0}
    comparison = compare_starts(problem, np.array([false[name] for name in problem.free_names]))
    assert comparison is not None
    assert comparison.best.name == "free"
    assert comparison.best.values["L"] == pytest.approx(3.0, abs=0.2)
