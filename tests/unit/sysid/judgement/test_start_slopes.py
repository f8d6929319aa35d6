"""Slopes of the outputs in assumed starts, and what is found with them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid.core.settings import GeneticAlgorithm, InitialSetting, Loss
from sysid.data.noise import Noise, add_output_noise
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.judgement.start_slopes import compute_start_slopes, list_assumed_starts
from sysid.models.model import FixedInitial, InitialState, MeasuredInitial, Model
from sysid.models.parse import parse_model
from sysid.simulation.problem import Problem
from sysid.simulation.simulate import simulate
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


THETA = np.array(list(TRUE.values()))
QUICK = GeneticAlgorithm(generations=50)
NOISE = 0.05


def find_start(
    model: Model, records: list[Record], initial: InitialSetting | None = None, **settings: Loss
) -> float | None:
    """Find the gain of the finding about starts; None if there is none."""
    found = identify(model, records, QUICK, initial=initial, **settings)
    return next((one.gain for one in found.findings if one.explanation == "start"), None)


@pytest.mark.parametrize("initial", [None, "rest"])
def test_a_slope_is_the_transient_that_a_start_leaves(initial: InitialSetting | None) -> None:
    problem = Problem.build(FIRST_ORDER, [make_record(0, 0.0)], initial=initial)
    assert list_assumed_starts(problem) == ["x"]
    slopes = compute_start_slopes(problem, THETA, "x", NOISE)
    expected = np.exp(-0.2 * np.arange(300) / TRUE["T"])
    np.testing.assert_allclose(slopes[:, 0], expected, atol=1e-4)


def test_a_start_acts_on_its_own_experiment_only() -> None:
    problem = Problem.build(FIRST_ORDER, [make_record(seed, 0.0) for seed in range(2)])
    slopes = compute_start_slopes(problem, THETA, "x", NOISE)
    assert slopes.shape == (600, 2)
    assert not slopes[300:, 0].any()
    assert not slopes[:300, 1].any()
    np.testing.assert_allclose(slopes[:300, 0], slopes[300:, 1], atol=1e-6)


def test_an_estimated_start_is_not_assumed() -> None:
    problem = Problem.build(FIRST_ORDER, [make_record(0, 0.0)], initial="free")
    assert list_assumed_starts(problem) == []
    second = Problem.build(SECOND_STATE, [make_record(0, 0.0, SECOND_STATE)])
    assert list_assumed_starts(second) == ["w", "x"]


def test_the_step_of_a_slope_follows_the_outputs_not_the_unit() -> None:
    """A brake that is cubic in x: with a first step of 1e-3 a simulation in this unit diverges."""
    document = {
        **FIRST_ORDER.document,
        "equations": {"x": "(K*u(t - L)/1e6 - x - 1e12*x**3)/T"},
        "outputs": {"y": "1e6*x"},
    }
    model = parse_model(document)
    problem = Problem.build(model, [make_record(0, 1e-6, model)])
    slopes = compute_start_slopes(problem, THETA, "x", NOISE)
    assert slopes[0, 0] == pytest.approx(1e6, rel=1e-3)
    assert np.all(np.isfinite(slopes))


@pytest.mark.parametrize("start", [FixedInitial(0.0), MeasuredInitial()])
def test_the_runs_of_a_sweep_get_the_slopes_that_they_would_get_alone(start: InitialState) -> None:
    """They share the problem with a free start, unless the start itself has noise."""
    tank = replace(TANK, initial=(start,))
    base = make_record(0, 2.0, TANK, noise=0.0)
    problem, theta = Problem.build(tank, [base]), np.array([2.0, 1.33])
    for seed in range(3):
        record = add_output_noise(base, Noise(0.2, seed))
        problem = problem.replace_outputs([record])
        alone = Problem.build(tank, [record])
        slopes = compute_start_slopes(problem, theta, "x", NOISE)
        np.testing.assert_array_equal(slopes, compute_start_slopes(alone, theta, "x", NOISE))


@pytest.mark.parametrize("start", [0.4, -0.4, 3.0])
@pytest.mark.parametrize("initial", [None, "rest"])
def test_a_wrong_start_is_found(start: float, initial: InitialSetting | None) -> None:
    for seed in draw_seeds(gate=1, night=30):
        rest = 2.0 * make_record(seed, 0.0).inputs[0].values[0] if initial == "rest" else 0.0
        record = make_record(seed, start + rest)
        gain = find_start(FIRST_ORDER, [record], initial)
        assert gain is not None
        assert gain > 50


def test_a_right_start_is_not_found_whatever_the_noise() -> None:
    for seed in draw_seeds(gate=2, night=60):
        for colour in (0.0, 0.9):
            assert find_start(FIRST_ORDER, [make_record(seed, 0.0, colour=colour)]) is None


def test_starts_of_opposite_sign_are_found() -> None:
    gain = find_start(FIRST_ORDER, [make_record(0, 0.3), make_record(1, -0.3)])
    assert gain is not None
    assert gain > 50


def test_the_start_of_another_state_than_the_measured_one_is_found() -> None:
    assert find_start(SECOND_STATE, [make_record(0, 1.0, SECOND_STATE)]) is not None


def test_no_noise_model_hides_a_wrong_start() -> None:
    """A tank whose level is not 0 at the start: the colour that this makes is not noise."""
    record = make_record(1, 2.0, TANK)
    for loss in (Loss(), Loss(noise_model="ar1")):
        assert find_start(TANK, [record], loss=loss) is not None
