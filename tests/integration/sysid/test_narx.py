"""Polynomials whose search begins with least squares one step ahead: the whole way."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, IslandChange, Stop
from sysid.data.records import Channel, Record
from sysid.export.export import export_model
from sysid.identification.identify import identify
from sysid.identification.run import begin_run
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.results.identification import Identification
from sysid.selection.starts import find_equation_error_starts
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from tests.support.library.polynomials import (
    LAGGED,
    TRUTH,
    build_lagged,
    document,
    frols,
    record_of,
)

NARX = {
    "a[y(k-1)]": 0.5,
    "a[y(k-1-dh)]": -0.2,
    "a[u(k-1)]": 0.6,
    "a[u(k-1-dk)]": 0.3,
    "a[y(k-1)**2]": -0.1,
    "a[y(k-1)*u(k-1)]": 0.15,
    "a[y(k-1-dh)*u(k-1-dk)]": -0.1,
    "a[u(k-1-dk)**2]": 0.2,
}
SMALL = GeneticAlgorithm(generations=40)


def narx_record(dh: float, dk: float, noise: float = 0.0, samples: int = 500) -> Record:
    """The catalogue model's free run from an input that is random in each sample."""
    model = load_model("narx")
    rng = np.random.default_rng(3)
    times = 0.1 * np.arange(samples)
    source = Channel("u", times, rng.uniform(-1.0, 1.0, samples))
    values = {one.name: 0.0 for one in model.parameters} | NARX | {"dh": dh, "dk": dk, "y(0)": 0.0}
    clean = simulate(model, [source], values, times=times).channel("y").values
    return Record((source,), (Channel("y", times, clean + noise * rng.standard_normal(samples)),))


def read_values(found: Identification) -> dict[str, float]:
    return {one.name: one.value for one in found.parameters}


def build_problem(record: Record, **fields: Any) -> Problem:
    return Problem.build(load_model("narx"), [record], **fields)


@pytest.mark.parametrize(
    ("dh", "dk"),
    [
        (3.0, 7.0),
        pytest.param(4.3, 12.6, marks=pytest.mark.slow),
        pytest.param(1.5, 30.2, marks=pytest.mark.night),
    ],
)
def test_all_coefficients_and_both_lags_of_the_catalogue_model_are_recovered(
    dh: float, dk: float
) -> None:
    model = load_model("narx")
    truth = {one.name: 0.0 for one in model.parameters} | NARX | {"dh": dh, "dk": dk}
    found = identify(model, narx_record(dh, dk))
    assert read_values(found) == pytest.approx(truth, abs=1e-6)


@pytest.mark.slow
def test_with_measurement_noise_they_are_recovered_within_their_errors() -> None:
    model = load_model("narx")
    truth = {one.name: 0.0 for one in model.parameters} | NARX | {"dh": 3.4, "dk": 7.7}
    found = identify(model, narx_record(3.4, 7.7, noise=0.05))
    assert found.rms == pytest.approx(0.05, rel=0.1)
    far = [
        one.name
        for one in found.parameters
        if one.stderr is None or abs(one.value - truth[one.name]) > 4 * one.stderr
    ]
    assert far == []


def test_the_starts_hold_the_solution_of_data_without_noise() -> None:
    posed = build_problem(narx_record(3.0, 7.0))
    starts = find_equation_error_starts(posed, GeneticAlgorithm())
    assert starts.values[0] == pytest.approx(
        {one.name: 0.0 for one in posed.free_parameters} | NARX | {"dh": 3.0, "dk": 7.0}, abs=1e-9
    )


def compute_fitness(posed: Problem, start: Any) -> float:
    theta = np.array([[start[one.name] for one in posed.free_parameters]])
    return float(posed.evaluate_fitness(theta)[0])


def test_starts_come_best_first_inside_the_bounds_and_finite() -> None:
    changes = {"a[u(k-1)]": {"lower": -0.1, "upper": 0.1}, "dk": {"upper": 5}}
    posed = build_problem(narx_record(3.0, 7.0, noise=0.1), parameters=changes)
    starts = find_equation_error_starts(posed, GeneticAlgorithm()).values
    reached = [compute_fitness(posed, start) for start in starts]
    assert reached == sorted(reached)
    assert np.isfinite(reached[-1])
    for start in starts:
        assert all(one.lower <= start[one.name] <= one.upper for one in posed.free_parameters)


def test_simulated_past_values_take_away_the_bias_of_noisy_ones() -> None:
    """One step ahead, noise pulls the coefficients of the past output towards zero."""
    record = record_of(TRUTH, samples=3000, noise=0.2)
    posed = Problem.build(parse_model(document(list(TRUTH))), [record])
    best = find_equation_error_starts(posed, GeneticAlgorithm()).values[0]
    assert best["a[y(k-1)]"] == pytest.approx(TRUTH["y(k-1)"], abs=0.05)
    assert best["a[y(k-2)]"] == pytest.approx(TRUTH["y(k-2)"], abs=0.05)


def test_a_fixed_coefficient_is_kept_and_the_others_are_solved_for() -> None:
    changes = {"a[y(k-1)]": {"fixed": TRUTH["y(k-1)"]}}
    record = record_of(TRUTH)
    posed = Problem.build(parse_model(document(list(TRUTH))), [record], parameters=changes)
    best = find_equation_error_starts(posed, GeneticAlgorithm()).values[0]
    rest = {f"a[{term}]": value for term, value in TRUTH.items() if term != "y(k-1)"}
    assert best == pytest.approx(rest, abs=1e-9)


def test_the_methods_of_the_paper_begin_without_starts() -> None:
    posed = build_problem(narx_record(3.0, 7.0))
    for method in ("simple", "improved-paper"):
        algorithm = GeneticAlgorithm(method=method)
        assert find_equation_error_starts(posed, algorithm).values == ()
    paper = IslandChange(method="improved-paper")
    mixed = GeneticAlgorithm(islands=(paper, IslandChange(method="improved")))
    other = GeneticAlgorithm(islands=(paper, paper))
    one, two = begin_run(posed, mixed, 1).islands
    alone = begin_run(posed, other, 1).islands
    assert np.array_equal(one.chromosomes, alone[0].chromosomes)
    assert not np.array_equal(two.chromosomes, alone[1].chromosomes)


def test_a_model_that_is_no_polynomial_has_no_starts() -> None:
    recursion = replace(load_model("narx"), form="difference")
    posed = Problem.build(recursion, [narx_record(3.0, 7.0)])
    assert find_equation_error_starts(posed, GeneticAlgorithm()).values == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    "evaluations", [100, *(pytest.param(one, marks=pytest.mark.night) for one in (200, 1000))]
)
def test_simulations_of_the_starts_count(evaluations: int) -> None:
    algorithm = GeneticAlgorithm(stop=Stop(evaluations=evaluations))
    posed = build_problem(narx_record(3.0, 7.0, noise=0.05))
    starts = find_equation_error_starts(posed, algorithm)
    assert 0 < starts.evaluations <= evaluations // 4
    assert begin_run(posed, algorithm, 1).evaluations == starts.evaluations
    found = identify(posed.model, posed.records, algorithm)
    assert found.evaluations <= evaluations


def selecting(**changes: Any) -> Model:
    return parse_model(build_lagged(frols(5), **changes))


def test_selected_terms_are_told_with_the_result_and_searched_with_their_lags() -> None:
    found = identify(selecting(), record_of(LAGGED, lags={"dh": 2.4, "dk": 5.6}), SMALL)
    assert {one.term for one in found.selection} == set(LAGGED)
    truth = {f"a[{term}]": value for term, value in LAGGED.items()} | {"dh": 2.4, "dk": 5.6}
    assert read_values(found) == pytest.approx(truth, abs=1e-5)
    cumulated = np.cumsum([one.err for one in found.selection])
    assert [one.cumulated for one in found.selection] == pytest.approx(list(cumulated))


def test_a_model_without_a_selection_tells_none() -> None:
    record = record_of(TRUTH)
    assert identify(parse_model(document(list(TRUTH))), record, SMALL).selection == ()


def test_terms_are_selected_on_the_part_for_estimation_only() -> None:
    record = record_of(TRUTH)
    values = record.outputs[0].values.copy()
    values[320:] = 100.0  # nonsense in the part for validation
    broken = replace(record, outputs=(replace(record.outputs[0], values=values),))
    model = parse_model(document(frols(5)))
    found = identify(model, broken, SMALL, validation_fraction=0.2)
    assert {one.term for one in found.selection} == set(TRUTH)
    assert found.rms == pytest.approx(0.0, abs=1e-6)


def test_the_same_selection_repeats_bit_for_bit() -> None:
    record = record_of(LAGGED, lags={"dh": 2.4, "dk": 5.6}, noise=0.05)
    one, other = (identify(selecting(), record, SMALL) for _ in range(2))
    assert one.selection == other.selection
    assert read_values(one) == read_values(other)


@pytest.mark.parametrize("islands", [1, 4])
@pytest.mark.parametrize("seed", range(4))
def test_a_start_that_is_the_optimum_already_is_found_and_told(seed: int, islands: int) -> None:
    rng = np.random.default_rng(seed)
    u, y = rng.normal(size=200), np.zeros(200)
    for k in range(2, 200):
        y[k] = 0.6 * y[k - 1] - 0.2 * y[k - 2] + 0.5 * u[k - 1] + 0.02 * rng.normal()
    times = np.arange(200.0)
    model = load_model(
        {
            "name": "arx",
            "form": "polynomial",
            "output": "y",
            "inputs": {"u": "1"},
            "coefficients": {"lower": -2, "upper": 2},
            "terms": ["y(k-1)", "y(k-2)", "u(k-1)"],
        }
    )
    record = Record((Channel("u", times, u, "1"),), (Channel("y", times, y, "1"),))
    algorithm = GeneticAlgorithm(islands=islands, generations=30)
    found = identify(model, [record], algorithm, seed=seed, prediction="one-step")
    assert all(history and history[0].phase == "start" for history in found.history)
    values = [one.value for one in found.parameters[:3]]
    np.testing.assert_allclose(values, [0.6, -0.2, 0.5], atol=0.02)


@pytest.mark.parametrize("longest", [2, 25])
def test_one_step_ahead_it_is_least_squares_behind_the_samples_it_starts_from(longest: int) -> None:
    # The first samples are given: counted as agreement they make every error too small.
    n, draw = 90, np.random.default_rng(5)
    u, y = draw.uniform(-1, 1, n), np.zeros(n)
    for k in range(longest, n):
        y[k] = 0.5 * y[k - 1] - 0.2 * y[k - longest] + 0.8 * u[k - 1]
    y += draw.normal(0, 0.05, n)
    terms = ["y(k-1)", f"y(k-{longest})", "u(k-1)"]
    model = parse_model(document(lags={"y": [1, longest], "u": [1]}, terms=terms))
    times = 0.1 * np.arange(n)
    record = Record((Channel("u", times, u, "V"),), (Channel("y", times, y, "V"),))
    found = identify(model, record, SMALL, prediction="one-step")
    late = np.arange(longest, n)
    rows = np.column_stack([y[late - 1], y[late - longest], u[late - 1]])
    solution, (squares,), *_ = np.linalg.lstsq(rows, y[late])
    errors = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)) * squares / (n - longest - 3))
    assert [one.value for one in found.parameters] == pytest.approx(solution, abs=1e-6)
    assert [one.stderr for one in found.parameters] == pytest.approx(errors, rel=1e-4)
    assert found.rms == pytest.approx(np.sqrt(squares / (n - longest)), rel=1e-6)
    assert found.criteria is not None
    assert found.criteria.samples == n - longest


def test_selected_terms_are_exported_as_the_result_has_them() -> None:
    record = record_of(TRUTH, noise=0.01)
    model = parse_model(document(frols(5)))
    found = identify(model, record, SMALL)
    program: dict[str, Any] = {}
    exec(compile(export_model(model, found, "python"), "exported", "exec"), program)
    times, u = record.inputs[0].times, record.inputs[0].values
    start = record.outputs[0].values[:2]
    again = np.asarray(program["simulate"](times, u, y_0=start)).ravel()
    np.testing.assert_allclose(again, found.simulated[0][0], rtol=1e-9, atol=1e-12)
