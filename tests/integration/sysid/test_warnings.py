"""What a result says of itself: each warning where it belongs, and not where it does not."""

from dataclasses import replace

import numpy as np
import pytest

from sysid.core.errors import NothingIdentifiable
from sysid.core.settings import GeneticAlgorithm
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.models.model import Model
from sysid.models.parse import parse_model
from sysid.results.identification import Identification
from sysid.simulation.simulate import simulate

QUICK = GeneticAlgorithm(population=30, generations=120)
STEP, N = 0.02, 300
FIRST = {
    "name": "one",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {
        "K": {"lower": -5, "upper": 5},
        "T": {"lower": 0.02, "upper": 2},
        "L": {"lower": 0, "upper": 1},
        "y0": {"lower": -5, "upper": 5},
    },
    "equations": {"x": "(K*u(t - L) - x)/T"},
    "outputs": {"y": "x + y0"},
    "initial": {"x": 0},
}
SECOND = {
    "name": "two",
    "form": "differential",
    "inputs": {"u": "1"},
    "states": {"a": "1", "b": "1"},
    "parameters": {"L": {"lower": 0, "upper": 1}},
    "outputs": {"y": "b"},
    "equations": {"a": "(u(t - L) - a)/0.3", "b": "(a - b)/0.3"},
    "initial": {"a": 0, "b": 0},
}


def make_steps(seed: int = 0) -> FloatArray:
    return np.repeat(np.random.default_rng(seed).standard_normal(N // 20), 20)


def make_record(u: FloatArray, y: FloatArray) -> Record:
    times = STEP * np.arange(N)
    return Record((Channel("u", times, u, "1", hold="zero"),), (Channel("y", times, y, "1"),))


def compute_response(model: Model, u: FloatArray, sd: float = 0.01, **values: float) -> FloatArray:
    times = STEP * np.arange(N)
    inputs = (Channel("u", times, u, "1", hold="zero"),)
    found = simulate(model, inputs, values, times=times).channel("y").values
    return found + sd * np.random.default_rng(1).standard_normal(N)


def is_warned(found: Identification, words: str) -> bool:
    return any(words in warning for warning in found.warnings)


def test_a_true_model_with_white_noise_has_no_warning() -> None:
    model = parse_model({**FIRST, "solver": {"substeps": 4}})
    y = compute_response(model, make_steps(), K=1.5, T=0.3, L=0.2, y0=0.3)
    assert identify(model, make_record(make_steps(), y), QUICK).warnings == ()


def test_a_model_of_too_low_an_order_is_told_that_its_lag_depends_on_it() -> None:
    y = compute_response(parse_model(SECOND), make_steps(), L=0.1)
    found = identify(parse_model(FIRST), make_record(make_steps(), y), QUICK)
    assert found.verdict.text == "trustworthy but for L: the data prefer sopdt"
    assert is_warned(found, "the data prefer sopdt (order 2) to fopdt (order 1)")
    assert is_warned(found, "the noise is coloured, and the standard errors allow for it")
    assert (found["L"].status, found["K"].status) == ("dependent", "identified")


def identify_beside_larger_steps() -> Identification:
    """A true model: a twentieth of the input tells K to a few hundredths, which all of it shows."""
    model, truth = parse_model(FIRST), {"K": 1.5, "T": 0.3, "L": 0.2, "y0": 0.3}
    small, large = 0.05 * make_steps(), make_steps(1)
    kept = make_record(large, compute_response(model, large, **truth))
    own = make_record(small, compute_response(model, small, **truth))
    return identify(model, own, QUICK, validation=[kept])


def test_residuals_on_validation_data_are_those_that_are_tested() -> None:
    found = identify_beside_larger_steps()
    assert found.residual_tests.data == "validation"
    assert found.residual_tests.passed is False
    assert all(one.status == "identified" for one in found.parameters)


def test_a_true_model_that_misses_in_another_range_is_not_said_to_lack_dynamics() -> None:
    found = identify_beside_larger_steps()
    assert not is_warned(found, "missing from the model")


def test_a_model_of_too_low_an_order_lacks_dynamics_on_validation_data_as_well() -> None:
    record = make_record(make_steps(), compute_response(parse_model(SECOND), make_steps(), L=0.1))
    found = identify(parse_model(FIRST), record, QUICK, validation=[record])
    assert found.verdict.text == "trustworthy but for L: the data prefer sopdt"


def test_an_estimate_that_may_as_well_be_zero_is_told() -> None:
    model = parse_model(FIRST)
    y = compute_response(model, make_steps(), sd=0.05, K=1.5, T=0.3, L=0.2, y0=0.0)
    found = identify(model, make_record(make_steps(), y), QUICK)
    vague = {e.name for e in found.parameters if e.stderr and e.stderr >= abs(e.value)}
    for estimate in found.parameters:
        expected = estimate.name in vague
        assert is_warned(found, f"the standard error of {estimate.name},") is expected


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_an_input_that_does_not_excite_names_what_it_leaves_open(level: float) -> None:
    u = np.full(N, level)
    model = parse_model(FIRST)
    y = compute_response(model, u, K=1.5, T=0.3, L=0.0, y0=0.2)
    found = identify(model, make_record(u, y), QUICK)
    open_ = {e.name for e in found.parameters if e.stderr is None}
    assert open_
    (text,) = (w for w in found.warnings if "excites nothing" in w)
    assert text.startswith("input 'u' is constant")
    assert all(name in text.rpartition("unidentified: ")[2] for name in open_)
    assert ("K" in open_) or level


def test_where_nothing_has_an_effect_the_run_fails_and_says_so() -> None:
    model = parse_model(SECOND)
    with pytest.raises(NothingIdentifiable, match="none of L has an effect on the output"):
        identify(model, make_record(np.zeros(N), np.sin(np.arange(N))), QUICK)


@pytest.mark.parametrize(("substeps", "too_long"), [(1, True), (8, False)])
def test_an_estimate_that_the_integration_step_has_made_is_replaced_and_told(
    substeps: int, too_long: bool
) -> None:
    # A time constant of a third of the step: the method of Runge and Kutta is at its limit there.
    tube = load_model("tube")
    exact, coarse = (replace(tube, solver=replace(tube.solver, substeps=n)) for n in (16, substeps))
    times = 0.01 * np.arange(600)
    inlet = Channel("u", times, np.interp(times, 0.3 * np.arange(21), make_steps()[:21]))
    truth = {"K": 1.0, "T": 0.0033, "L": 0.024, "y(0)": float(inlet.values[0])}
    outlet = simulate(exact, [inlet], truth, times=times).channel("y")
    noisy = replace(outlet, values=outlet.values + np.random.default_rng(1).normal(0, 1e-3, 600))
    found = identify(coarse, Record((inlet,), (noisy,)))
    assert is_warned(found, "the integration step of the model, substeps: 1") == too_long
    assert (found.substeps > substeps) == too_long
    for one in found.parameters:
        assert one.stderr is not None
        assert abs(one.value - truth[one.name]) < 3 * one.stderr


@pytest.mark.parametrize(
    "level",
    [
        0.0,
        3.0,
        0.3,  # its mean is not quite 0.3
    ],
)
def test_a_constant_output_is_the_verdict(level: float) -> None:
    found = identify(parse_model(FIRST), make_record(make_steps(), np.full(N, level)), QUICK)
    assert found.verdict.text.startswith("not trustworthy: the output is constant")
    assert not any(one.status == "identified" for one in found.parameters)


@pytest.mark.parametrize("level", [0.0, 0.3])
def test_a_constant_output_is_told(level: float) -> None:
    found = identify(parse_model(FIRST), make_record(make_steps(), np.full(N, level)), QUICK)
    assert is_warned(
        found, f"output 'y' is constant ({level:g}) at all {N} samples: it contains no"
    )
    moving = np.where(np.arange(N) == 7, level + 0.1, level)
    assert not is_warned(
        identify(parse_model(FIRST), make_record(make_steps(), moving), QUICK), "is constant"
    )


def test_each_estimate_that_is_not_identified_is_told_with_its_reason() -> None:
    found = identify(parse_model(FIRST), make_record(make_steps(), np.full(N, 3.0)), QUICK)
    alone = [e for e in found.parameters if e.status == "unidentifiable"]
    assert alone
    [note] = [note for note in found.warnings if note.startswith("the data do not determine")]
    for one in alone:
        assert f"{one.name}: {one.reason}" in note


def test_one_step_ahead_without_an_output_that_is_a_state_is_told_to_be_the_free_run() -> None:
    hidden, y = parse_model(FIRST), compute_response(parse_model(SECOND), make_steps(), L=0.1)
    free = identify(hidden, make_record(make_steps(), y), QUICK)
    ahead = identify(hidden, make_record(make_steps(), y), QUICK, prediction="one-step")
    assert is_warned(ahead, "no output (y) is a state by itself")
    assert [one.stderr for one in ahead.parameters] == [one.stderr for one in free.parameters]
    tube, narrow = load_model("tube"), {"L": {"upper": 1.0}}
    seen = identify(
        tube, make_record(make_steps(), y), QUICK, prediction="one-step", parameters=narrow
    )
    assert not is_warned(seen, "is a state by itself")
