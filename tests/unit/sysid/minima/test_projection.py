"""Linear parameters are found on the outputs, and solved for at drawn places."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification import best_estimate
from sysid.identification.identify import identify
from sysid.minima.minima import scan_by_projection
from sysid.minima.projection import draw_projected_points, find_linear_parameters
from sysid.minima.search_evidence import is_explained
from sysid.models.catalogue.load import load_model
from sysid.models.parse import parse_model
from sysid.residuals.residual_tests import run_residual_tests
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.scaling import to_unit
from sysid.simulation.simulate import simulate
from tests.support.library.search_problems import example

TRUTH = {"K": 0.9, "T1": 0.3, "r": 0.6, "L": 0.17, "y0": 4.8, "w(0)": -0.6, "x(0)": -0.1}


def make_telegraph(noise: float = 0.05, colour: float = 0.0) -> Record:
    """A second-order plant under an input of two levels at random, far faster than its bounds."""
    random = np.random.default_rng(11)
    times = 0.08 * np.arange(400)
    u = Channel("u", times, np.repeat(random.choice([-1.5, 1.5], 100), 4), hold="zero")
    y = simulate(load_model("sopdt"), [u], TRUTH, times=times).channels[0]
    slow = colour * np.sin(0.4 * times) * np.sin(1.1 * times)
    return Record((u,), (replace(y, values=y.values + slow + random.normal(0, noise, 400)),))


def build_plant() -> Problem:
    return Problem.build(load_model("sopdt"), [make_telegraph()])


def place(problem: Problem, **changes: float) -> FloatArray:
    return np.array([{**TRUTH, **changes}[name] for name in problem.free_names])


def test_gain_offset_and_starts_of_a_linear_plant_are_linear() -> None:
    problem = build_plant()
    for theta in (place(problem), place(problem, K=-20.0, T1=30.0, L=9.0)):
        linear, spent = find_linear_parameters(problem, theta)
        assert {problem.free_names[d] for d in linear} == {"K", "y0", "w(0)", "x(0)"}
        assert spent <= 3 * theta.size + 1


def test_two_gains_in_a_row_are_not_linear_together() -> None:
    document: dict[str, Any] = {
        "name": "two-gains",
        "form": "differential",
        "inputs": {"u": "1"},
        "states": {"w": "1", "x": "1"},
        "parameters": {name: {"lower": 0.1, "upper": 3.0} for name in "abT"},
        "equations": {"w": "(a*u - w)/T", "x": "b*w - x"},
        "outputs": {"y": "x"},
        "initial": {"w": 0, "x": 0},
    }
    record = make_telegraph()
    problem = Problem.build(parse_model(document), [record])
    linear, _ = find_linear_parameters(problem, np.array([1.0, 1.0, 1.0]))
    assert [problem.free_names[d] for d in linear] in (["a"], ["b"])


def test_a_nonlinear_model_has_no_linear_parameter_and_costs_no_more_than_the_test() -> None:
    problem = example()
    theta = np.array([0.2, 0.5, 5.0, 1.0])
    assert find_linear_parameters(problem, theta)[0] == []
    places, fitness, spent = draw_projected_points(problem, theta, 1, 5000)
    assert (len(places), len(fitness)) == (0, 0)
    assert spent <= 3 * theta.size + 1


def test_at_drawn_places_no_linear_parameter_can_be_better() -> None:
    problem = build_plant()
    places, fitness, spent = draw_projected_points(problem, place(problem), 1, 2000)
    lower, upper = problem.evaluator.lower, problem.evaluator.upper
    assert len(places) > 100
    assert spent <= 2000
    assert np.all((places >= lower) & (places <= upper))
    np.testing.assert_array_equal(fitness, problem.evaluate_fitness(places))
    linear = [problem.free_names.index(name) for name in ("K", "y0", "w(0)", "x(0)")]
    inside = np.all((places > lower) & (places < upper), axis=1)
    random = np.random.default_rng(2)
    for _ in range(20):
        moved = places[inside].copy()
        moved[:, linear] += 1e-2 * random.standard_normal((len(moved), len(linear)))
        assert np.all(problem.evaluate_fitness(moved) >= fitness[inside] * (1 - 1e-9))
    unit = to_unit(problem.evaluator, places)
    for d in set(range(len(lower))) - set(linear):  # the others are spread over their range
        np.testing.assert_allclose(np.quantile(unit[:, d], [0.25, 0.75]), [0.25, 0.75], atol=0.01)


@pytest.mark.parametrize("seed", range(1, 6))
def test_a_scan_by_projection_leads_out_of_a_false_minimum(seed: int) -> None:
    problem = build_plant()
    false, best = refine_candidates(
        problem, [place(problem, K=-0.5, L=9.0, T1=0.5), place(problem)]
    )
    assert false is not None
    assert best is not None
    assert false.rms > 3 * best.rms
    found = scan_by_projection(problem, false, seed, 6000)
    assert found.best.rms == pytest.approx(best.rms, rel=1e-6)
    assert found.evaluations <= 6000
    assert found.starts == 6


def test_a_budget_is_kept_and_a_small_one_draws_nothing() -> None:
    problem = build_plant()
    for budget in (0, 10, 100, 300, 700):
        places, _, spent = draw_projected_points(problem, place(problem), 1, budget)
        assert spent <= budget
        assert (len(places) > 0) == (budget >= 700)


@pytest.mark.parametrize("seed", [1, 3])
def test_the_bounds_of_a_catalogue_model_hide_no_lag(seed: int) -> None:
    """Residuals with a part of a disturbance: nothing shows that the search has found all."""
    free_run = Loss(noise_model="white")
    found = identify(load_model("sopdt"), make_telegraph(colour=0.3), seed=seed, loss=free_run)
    (lag,) = (one for one in found.parameters if one.name == "L")
    assert lag.value == pytest.approx(TRUTH["L"], abs=0.05)
    assert found.search.agreeing_starts >= 2


def test_negligible_residuals_and_noise_leave_no_doubt() -> None:
    problem = build_plant()
    assert is_explained(problem, 0.9e-3 * problem.output_scale, None)
    assert not is_explained(problem, 1.1e-3 * problem.output_scale, None)
    for theta, explained in ((place(problem), True), (place(problem, L=0.6), False)):
        simulated = problem.predict(theta[None])[0]
        (rms,) = problem.evaluate_fitness(theta[None])
        tests = run_residual_tests(problem, simulated, "estimation")
        assert is_explained(problem, rms, tests) == explained


def test_nothing_is_drawn_where_the_residuals_are_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is in doubt there, although hardly a random start agrees."""

    def refuse(*_: object) -> None:
        pytest.fail("places were drawn")

    monkeypatch.setattr(best_estimate, "scan_by_projection", refuse)
    quick = GeneticAlgorithm(generations=60)
    found = identify(load_model("sopdt"), make_telegraph(), quick, seed=1)
    assert found.search.because == "residuals"
    assert found.search.agreeing_starts < 2
