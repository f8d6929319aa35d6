"""Least squares from the champions: never worse, inside the bounds, counted."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.settings import Loss
from sysid.data.records import Channel, Record
from sysid.models.catalogue.load import load_model
from sysid.search import least_squares, refine
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import to_unit
from tests.support.library.search_problems import example, force, noisy, record

NEAR = np.array([0.22, 0.52, 5.1, 1.1])


def test_refinement_finds_the_optimum_beside_its_start() -> None:
    end = refine_candidates(example(sd=0.0), [NEAR])[0]
    assert end is not None
    assert end.rms < 1e-10
    assert np.allclose(end.theta, [0.2, 0.5, 5.0, 1.0], atol=1e-8)


def test_no_refined_start_is_worse_or_out_of_bounds() -> None:
    problem = example()
    starts = problem.evaluator.upper * np.random.default_rng(1).random((6, 4))
    before = problem.evaluate_fitness(starts)
    for value, end in zip(before, refine_candidates(problem, list(starts)), strict=True):
        if end is not None:
            assert end.rms <= value
            assert end.rms == problem.evaluate_fitness(end.theta[None])[0]
            assert np.all((end.theta >= 0) & (end.theta <= problem.evaluator.upper))
            assert end.evaluations > 0


def test_starts_beside_each_other_are_refined_once() -> None:
    ends = refine_candidates(example(), [NEAR, NEAR + 1e-5, NEAR - 1e-5])
    assert sum(end is not None for end in ends) == 1


def test_a_spent_budget_leaves_the_starts_alone() -> None:
    assert refine_candidates(example(), [NEAR], evaluations=5) == (None,)
    end = refine_candidates(example(), [NEAR], evaluations=30)[0]
    assert end is not None
    assert end.evaluations <= 32


def test_an_optimum_on_the_bound_is_reached_exactly() -> None:
    changes = {"a": {"lower": 1.5, "upper": 5.0}}  # the true value is 1
    problem = Problem.build(load_model("duffing-eq16"), [record(noisy())], parameters=changes)
    end = refine_candidates(problem, [np.array([0.2, 0.5, 5.0, 2.0])])[0]
    assert end is not None
    assert end.theta[3] == 1.5


@pytest.mark.parametrize(("lower", "upper"), [(1.5, 5.0), (0.0, 0.8)])
def test_a_solution_beside_a_bound_is_moved_onto_it(lower: float, upper: float) -> None:
    changes = {"a": {"lower": lower, "upper": upper}}  # the true value, 1, lies beyond
    problem = Problem.build(load_model("duffing-eq16"), [record(noisy())], parameters=changes)
    bound = min(max(1.0, lower), upper)
    place = to_unit(problem.evaluator, np.array([[0.2, 0.5, 5.0, bound]]))[0]
    place[3] += 5e-7 if lower > 1.0 else -5e-7
    theta, rms = refine._snap_to_bounds(problem.evaluator, place)
    assert theta[3] == bound
    assert rms == problem.evaluate_fitness(theta[None])[0]


def test_robust_refinement_withstands_outliers() -> None:
    y = noisy()
    y[::20] += 2.0
    model = load_model("duffing-eq16")
    robust = Problem.build(model, [record(y)], loss=Loss("soft-l1", 0.02))
    end = refine_candidates(robust, [NEAR])[0]
    assert end is not None
    assert end.theta[1] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_refinement_does_not_depend_on_the_unit_of_the_data(unit: float) -> None:
    document = {
        "name": "test",
        "form": "difference",
        "inputs": {"q": "N"},
        "states": {"x": "m"},
        "parameters": {"g": {"lower": 0, "upper": 10}, "p": {"lower": 0, "upper": 0.9}},
        "equations": {"x": "g*q(k-1) + p*x(k-1)"},
        "outputs": {"y": "x"},
        "initial": {"x": 0},
    }
    source = force(100)
    source = replace(source, values=unit * source.values)
    y = np.zeros(100)
    for k in range(1, 100):
        y[k] = 2.0 * source.values[k - 1] + 0.5 * y[k - 1]
    data = Record((source,), (Channel("y", source.times, y, "m"),))
    end = refine_candidates(Problem.build(load_model(document), [data]), [np.array([7.0, 0.2])])[0]
    assert end is not None
    assert end.theta == pytest.approx([2.0, 0.5], rel=1e-9)


def test_on_long_records_a_compiled_call_makes_few_steps_and_the_bits_are_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[int] = []

    def note_and_solve(
        *arguments: object, at_once: int, **settings: object
    ) -> least_squares.LeastSquaresSolution:
        calls.append(at_once)
        return least_squares.solve_least_squares(*arguments, at_once=at_once, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr(refine, "solve_least_squares", note_and_solve)
    problem = example()
    whole = refine_candidates(problem, [NEAR])[0]
    monkeypatch.setattr(
        least_squares, "_STEPS_PER_CALL", 2 * problem.n_steps * (4 + least_squares.N_TRIED)
    )
    cut = refine_candidates(problem, [NEAR])[0]
    monkeypatch.setattr(least_squares, "_STEPS_PER_CALL", 1)  # a record longer than any
    single = refine_candidates(problem, [NEAR])[0]
    assert calls[0] > 60
    assert calls[1:] == [2, 1]
    assert whole is not None
    for other in (cut, single):
        assert other is not None
        assert other.theta.tobytes() == whole.theta.tobytes()
        assert (other.rms, other.evaluations) == (whole.rms, whole.evaluations)
