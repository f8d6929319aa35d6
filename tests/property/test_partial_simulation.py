"""Laws of simulating a part of the record: it is the beginning of the whole."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.islands.archipelago import make_plans
from sysid.models.catalogue.load import load_model
from sysid.search.slopes import evaluate_partial_fitness
from sysid.simulation.evaluator import predict_partially
from sysid.simulation.problem import Problem, compute_record_progress
from sysid.simulation.scaling import from_unit
from tests.support.library.search_problems import example, record
from tests.support.profiles import scale_examples


def irregular(n: int, seed: int) -> Record:
    """A first-order plant's record with samples at times of their own."""
    times = np.sort(np.random.default_rng(seed).uniform(0.0, 4.0, n))
    held = Channel("u", np.array([0.0, 1.0, 2.5]), np.array([0.0, 1.0, -1.0]), "1", hold="zero")
    return Record((held,), (Channel("y", times, np.sin(times)),))


def build_problems() -> dict[str, Problem]:
    plant = load_model("fopdt")
    bounds = {"L": {"upper": 0.5}}
    short, long = example(n=60), np.zeros(140)
    two = Problem.build(short.model, [record(short.evaluator.measured), record(long)])
    between = [irregular(30, 1), irregular(45, 2)]
    return {"two": two, "between": Problem.build(plant, between, parameters=bounds)}


POSED = build_problems()


def draw_candidates(problem: Problem, seed: int) -> FloatArray:
    places = np.random.default_rng(seed).random((5, len(problem.free_parameters)))
    return np.asarray(from_unit(problem.evaluator, places))


@settings(max_examples=scale_examples(30))
@given(st.sampled_from(sorted(POSED)), st.floats(0.01, 1.0), st.integers(0, 99))
def test_a_part_of_the_simulation_is_the_beginning_of_the_whole(
    name: str, horizon: float, seed: int
) -> None:
    problem = POSED[name]
    theta = draw_candidates(problem, seed)
    part = predict_partially(problem.evaluator, theta, horizon)[:, :5].T
    reached = compute_record_progress(problem) <= horizon
    whole = problem.predict(theta)[:, reached]
    assert np.array_equal(part[:, reached], whole, equal_nan=True)


def test_a_part_reaches_a_sample_between_two_steps_at_its_end() -> None:
    problem = POSED["between"]
    theta, progress = draw_candidates(problem, 1), compute_record_progress(problem)
    whole = problem.predict(theta)
    for m in range(0, progress.size, 4):
        part = predict_partially(problem.evaluator, theta, float(progress[m]))[:, :5].T
        assert np.array_equal(part[:, m], whole[:, m], equal_nan=True)


@pytest.mark.parametrize("name", sorted(POSED))
def test_fitness_by_the_whole_part_is_fitness(name: str) -> None:
    problem = POSED[name]
    theta = draw_candidates(problem, 3)
    plan = make_plans(problem, GeneticAlgorithm(), 1)[0]
    predicted = predict_partially(problem.evaluator, theta, 1.0)
    found = evaluate_partial_fitness(problem.evaluator, plan, predicted, 1.0)[:5]
    assert found == pytest.approx(problem.evaluate_fitness(theta), rel=1e-12)


def test_progress_rises_to_one_in_each_experiment() -> None:
    for problem in POSED.values():
        for part in problem.split_by_output(compute_record_progress(problem)):
            assert np.all(np.diff(part["y"]) >= 0)
            assert part["y"][-1] == 1.0
