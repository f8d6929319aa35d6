"""Whether a record starts where its model says."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid.core.settings import GeneticAlgorithm, Loss
from sysid.data.noise import Noise, add_output_noise
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.judgement.fixed_start import warn_fixed_starts
from sysid.models.model import FixedInitial, MeasuredInitial, Model
from sysid.models.parse import parse_model
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
from sysid.uncertainty.analysis import analyse_estimate
from tests.support.profiles import draw_seeds

TRUE = {"K": 2.0, "T": 1.5, "L": 1.33}
FIRST_ORDER = parse_model(
    {
        "name": "first-order",
        "form": "differential",
        "inputs": {"u": "V"},
        "states": {"x": "V"},
        "parameters": {
            "K": {"lower": 0, "upper": 10},
            "T": {"lower": 0.05, "upper": 10, "unit": "s"},
            "L": {"lower": 0, "upper": 5, "unit": "s"},
        },
        "equations": {"x": "(K*u(t - L) - x)/T"},
        "outputs": {"y": "x"},
    }
)
TANK = parse_model(
    {
        **FIRST_ORDER.document,
        "parameters": {k: v for k, v in FIRST_ORDER.document["parameters"].items() if k != "T"},
        "equations": {"x": "K*u(t - L)"},
    }
)
SECOND_STATE = parse_model(
    {
        **FIRST_ORDER.document,
        "states": {"w": "V", "x": "mV"},
        "equations": {"w": "(K*u(t - L) - w)/T", "x": "(1000*w - x)/0.4"},
        "outputs": {"y": "x/1000"},
    }
)


def make_record(
    seed: int,
    start: float,
    model: Model = FIRST_ORDER,
    colour: float = 0.0,
    samples: int = 300,
    noise: float = 0.05,
) -> Record:
    """A test by steps whose first state starts there; the noise is coloured by one pole."""
    rng = np.random.default_rng(seed)
    times = 0.2 * np.arange(samples)
    command = np.repeat(rng.uniform(-1, 1, samples // 10), 10)
    channel = Channel("u", times, command, "V", "zero")
    moved = replace(model, initial=(FixedInitial(start), *model.initial[1:]))
    true = {parameter.name: TRUE[parameter.name] for parameter in model.parameters}
    [y] = simulate(moved, [channel], true, times=times).channels
    error = lfilter([1.0], [1.0, -colour], noise * rng.normal(size=samples))
    return Record((channel,), (replace(y, values=y.values + error),))


def list_notes(problem: Problem) -> list[str]:
    true = np.array([TRUE[name] for name in problem.free_names])
    [end] = refine_candidates(problem, [true])
    assert end is not None
    return warn_fixed_starts(problem, end.theta, analyse_estimate(problem, end.theta))


@pytest.mark.parametrize("start", [0.4, -0.4, 3.0])
def test_a_wrong_fixed_start_is_named_with_the_better_value(start: float) -> None:
    for seed in draw_seeds(gate=3, night=100):
        [note] = list_notes(Problem.build(FIRST_ORDER, [make_record(seed, start)]))
        assert note.startswith("the record does not start at x = 0 V. The data give x(0) = ")
        value, stderr = note.split("x(0) = ")[1].split(" V.")[0].split(" ± ")
        assert abs(float(value) - start) < 5 * float(stderr) < 0.2


def test_the_moves_are_those_of_an_estimate_with_that_start_free() -> None:
    record = make_record(3, 3.0)
    [note] = list_notes(Problem.build(FIRST_ORDER, [record]))
    document = {**FIRST_ORDER.document, "initial": {"x": {"lower": -3, "upper": 6}}}
    assert note.endswith(
        "Let the start be estimated: initial: {x: {lower: -3, upper: 6}}, or initial: steady for a "
        "plant at rest"
    )
    freed = identify(parse_model(document), record, GeneticAlgorithm(generations=50))
    for estimate in freed.parameters[:3]:
        assert f"{estimate.name} is {estimate.value:.4g} ± {estimate.stderr:.2g}" in note


@pytest.mark.parametrize("start", [FixedInitial(0.0), MeasuredInitial()])
def test_the_runs_of_a_sweep_get_the_warnings_that_they_would_get_alone(
    start: FixedInitial | MeasuredInitial,
) -> None:
    """They share the problem with a free start, unless the start itself has noise."""
    tank = replace(TANK, initial=(start,))
    base = make_record(0, 2.0, TANK, noise=0.0)
    problem, found = Problem.build(tank, [base]), []
    for seed in range(3):
        record = add_output_noise(base, Noise(0.2, seed))
        problem = problem.replace_outputs([record])
        found.append(list_notes(problem))
        assert found[-1] == list_notes(Problem.build(tank, [record]))
    assert any(found)


def test_of_a_right_start_nothing_is_reported_whatever_the_noise() -> None:
    for seed in draw_seeds(gate=8, night=200):
        for colour in (0.0, 0.9):
            assert (
                list_notes(Problem.build(FIRST_ORDER, [make_record(seed, 0.0, colour=colour)]))
                == []
            )


def test_the_noise_of_a_measured_start_is_reported_where_it_moves_an_estimate() -> None:
    tank = replace(TANK, initial=(MeasuredInitial(),))
    records = [make_record(seed, 2.0, TANK, noise=0.2) for seed in range(4)]
    found = [list_notes(Problem.build(tank, [record])) for record in records]
    assert sum(map(len, found)) >= 2
    [note] = next(one for one in found if one)
    value, stderr = note.split("The data give x(0) = ")[1].split(" V.")[0].split(" ± ")
    assert note.startswith("the record does not start at the first measured x.")
    assert abs(float(value) - 2.0) < 4 * float(stderr) < 0.2
    assert "With it free K is 2.0" in note or "With it free K is 1.99" in note


def test_a_measured_start_that_moves_no_estimate_is_not_reported() -> None:
    plant = replace(FIRST_ORDER, initial=(MeasuredInitial(),))
    record = make_record(0, 2.0)
    [y] = record.outputs
    y.values[0] += 3.0
    known = {"K": {"fixed": 2.0}, "T": {"fixed": 1.5}}
    assert list_notes(Problem.build(plant, [record], parameters=known)) == []


def test_a_start_that_moves_the_output_by_rounding_is_not_named() -> None:
    """Without noise any start is significant; a wrong one of 1e-8 moves nothing."""
    assert list_notes(Problem.build(FIRST_ORDER, [make_record(0, 1e-8, noise=0.0)])) == []
    assert list_notes(Problem.build(FIRST_ORDER, [make_record(0, 1e-3, noise=0.0)])) != []


def test_residuals_that_drift_say_nothing_about_a_start() -> None:
    """A start explains a part of any slow line, and its standard error is too small."""
    for seed in draw_seeds(gate=3, night=20):
        record = make_record(seed, 0.0, TANK, samples=1000)
        [y] = record.outputs
        line = 2.0 - 2.0 * np.cos(2 * np.pi * np.linspace(0, 1, y.values.size))
        drifting = replace(record, outputs=(replace(y, values=y.values - line),))
        assert list_notes(Problem.build(TANK, [drifting])) == []


def test_only_the_experiment_that_starts_elsewhere_is_named() -> None:
    [note] = list_notes(
        Problem.build(FIRST_ORDER, [make_record(0, 0.0), make_record(1, 0.0), make_record(2, 1)])
    )
    assert "x(0)[3] = " in note
    assert "x(0) = " not in note
    assert "x(0)[2]" not in note


def test_starts_of_opposite_sign_are_named_each() -> None:
    [note] = list_notes(Problem.build(FIRST_ORDER, [make_record(0, 0.3), make_record(1, -0.3)]))
    assert "x(0) = 0." in note
    assert "x(0)[2] = -0." in note


def test_only_the_state_that_starts_elsewhere_is_named() -> None:
    [note] = list_notes(Problem.build(SECOND_STATE, [make_record(0, 1.0, SECOND_STATE)]))
    assert note.startswith("the record does not start at w = 0 V. The data give w(0) = ")
    assert "x(0)" not in note


def test_the_step_of_a_slope_follows_the_outputs_not_the_unit() -> None:
    """A brake that is cubic in x: with a first step of 1e-3 a simulation in this unit diverges."""
    document = {
        **FIRST_ORDER.document,
        "equations": {"x": "(K*u(t - L)/1e6 - x - 1e12*x**3)/T"},
        "outputs": {"y": "1e6*x"},
    }
    model = parse_model(document)
    [note] = list_notes(Problem.build(model, [make_record(0, 1e-6, model)]))
    value, stderr = note.split("x(0) = ")[1].split(" V.")[0].split(" ± ")
    assert abs(float(value) - 1e-6) < 5 * float(stderr) < 0.5e-6


def test_a_free_run_of_squares_in_time_is_tested_and_nothing_else() -> None:
    record = make_record(0, 3.0)
    assert list_notes(Problem.build(FIRST_ORDER, [record], prediction="one-step")) == []
    assert list_notes(Problem.build(FIRST_ORDER, [record], loss=Loss("soft-l1", 0.1))) == []
    problem = Problem.build(FIRST_ORDER, [record])
    [end] = refine_candidates(problem, [np.array(list(TRUE.values()))])
    assert end is not None
    analysis = analyse_estimate(problem, end.theta)
    assert warn_fixed_starts(problem, end.theta, analysis, lambda: True) == []
    assert warn_fixed_starts(problem, end.theta, analysis, lambda: False) != []


def test_a_result_warns_also_under_a_noise_model() -> None:
    """A tank whose level is not 0 at the start: the colour that this makes is not noise."""
    record = make_record(0, 2.0, TANK)
    for loss in (Loss(), Loss(noise_model="ar1")):
        found = identify(TANK, record, GeneticAlgorithm(generations=50), loss=loss)
        [note] = [one for one in found.warnings if "does not start at x = 0 V" in one]
        assert "steady" not in note  # a tank has no rest
