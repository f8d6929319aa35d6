"""The noise model ``auto``: first-order noise where nothing but noise explains the residuals."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Loss, Stop
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import load_model
from sysid.results.identification import Identification
from sysid.simulation.problem import Problem
from sysid.uncertainty.profile_likelihood import compute_profile
from tests.unit.sysid.residuals.test_coloured import colour_noise

STEP, N = 0.1, 400
AUTO, WHITE, AR1 = (Loss(noise_model=name) for name in ("auto", "white", "ar1"))
SMALL = GeneticAlgorithm(population=24, generations=20)
K, OFFSET, T = 0.8, 0.3, 2.0

TANK: dict[str, Any] = {
    "name": "tank",
    "form": "difference",
    "inputs": {"u": "1"},
    "states": {"x": "1"},
    "parameters": {"K": {"lower": -10, "upper": 10}, "o": {"lower": -10, "upper": 10}},
    "equations": {"x": "x(k-1) + h*(K*u(k-1) - o)"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}
LAG = {
    **TANK,
    "name": "lag",
    "constants": {"T": T},
    "equations": {"x": "x(k-1) + h*(K*u(k-1) - o - x(k-1))/T"},
}


def make_signal(seed: int = 1, n: int = N) -> FloatArray:
    return np.repeat(np.random.default_rng([seed, 1]).choice([-1.0, 2.0], n // 10), 10)


def make_record(y: FloatArray, u: FloatArray | None = None) -> Record:
    times = STEP * np.arange(y.size)
    u = make_signal(n=y.size) if u is None else u
    return Record((Channel("u", times, u),), (Channel("y", times, y),))


def build_plant(rate: float, disturbance: FloatArray) -> FloatArray:
    """x' = K u - o - rate x + disturbance, from 0 on."""
    u, x = make_signal(n=disturbance.size), np.zeros(disturbance.size)
    for k in range(1, x.size):
        gain = rate if rate > 0 else 1.0
        flow = gain * (K * u[k - 1] - OFFSET) - rate * x[k - 1]
        x[k] = x[k - 1] + STEP * (flow + disturbance[k - 1])
    return x


def simulate_disturbed(seed: int, rate: float = 0.0) -> FloatArray:
    """Output of the plant under a random inflow."""
    return build_plant(rate, colour_noise(N, 0.5, seed)) + 0.01 * colour_noise(N, 0.0, seed + 100)


def simulate_delayed(seed: int) -> FloatArray:
    """Output of the lag with a dead time, whose misfit whitening moves to low frequencies."""
    late = np.concatenate([np.zeros(8), build_plant(1.0 / T, np.zeros(N))[:-8]])
    return np.asarray(late + 0.01 * colour_noise(N, 0.0, seed))


def identify_plant(
    model: dict[str, Any], y: FloatArray, loss: Loss, **options: Any
) -> Identification:
    settings = options.pop("settings", SMALL)
    return identify(load_model(model), make_record(y), settings, loss=loss, **options)


def same(one: Identification, other: Identification) -> bool:
    """Whether all numbers of two results are equal, bit for bit."""
    return (
        one.parameters == other.parameters
        and (one.rms, one.criteria) == (other.rms, other.criteria)
        and one.evaluations == other.evaluations
        and one.correlation_times == other.correlation_times
        and one.residual_tests == other.residual_tests
    )


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_a_drift_of_an_integrator_is_taken_for_noise_and_squares_are_told(seed: int) -> None:
    y = simulate_disturbed(seed)
    auto, white, ar1 = (identify_plant(TANK, y, loss) for loss in (AUTO, WHITE, AR1))
    assert auto.noise_model == "ar1"
    assert auto.parameters == ar1.parameters
    assert auto.correlation_times == ar1.correlation_times
    assert auto.parameters != white.parameters
    (note,) = (one for one in auto.warnings if "loss=Loss(noise_model='white')" in one)
    for one in white.parameters:
        assert f"{one.name} = {one.value:.4g}" in note


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_dynamics_that_the_model_lacks_are_left_to_squares(seed: int) -> None:
    auto, white, ar1 = (
        identify_plant(LAG, simulate_delayed(seed), loss) for loss in (AUTO, WHITE, AR1)
    )
    assert ar1.correlation_times["y"] > 0
    assert auto.parameters == white.parameters
    assert auto.warnings == white.warnings
    assert auto.noise_model == "white"


def test_validation_data_never_choose() -> None:
    """Data that one or the other predicts better score the same estimates."""
    y = simulate_disturbed(2)
    alone, white, ar1 = (identify_plant(TANK, y, loss) for loss in (AUTO, WHITE, AR1))
    for better in (white, ar1):
        values = [one.value for one in better.parameters]
        problem = Problem.build(load_model(TANK), [make_record(y)])
        other = make_record(problem.predict(np.array([values]))[0])
        auto = identify_plant(TANK, y, AUTO, validation=other)
        assert auto.noise_model == alone.noise_model
        assert [one.value for one in auto.parameters] == [one.value for one in alone.parameters]
        assert [one.stderr for one in auto.parameters] == [one.stderr for one in alone.parameters]


@pytest.mark.parametrize("model", [TANK, LAG])
@pytest.mark.parametrize("sd", [0.0, 1e-9, 0.05])
def test_white_noise_and_no_noise_change_nothing(model: dict[str, Any], sd: float) -> None:
    rate = 0.0 if model is TANK else 1.0 / T
    y = build_plant(rate, np.zeros(N)) + sd * colour_noise(N, 0.0, 7)
    auto, white = (identify_plant(model, y, loss) for loss in (AUTO, WHITE))
    assert same(auto, white)
    assert auto.warnings == white.warnings


def test_too_long_a_step_of_the_integration_is_told_and_not_taken_for_noise() -> None:
    stiff = {
        "name": "stiff",
        "form": "differential",
        "inputs": {"u": "1"},
        "states": {"w": "1", "x": "1"},
        "parameters": {
            "K": {"lower": 0.1, "upper": 10},
            "o": {"lower": -10, "upper": 10},
            "T": {"lower": 0.5, "upper": 3},
        },
        "equations": {"w": "(u - w)/(0.05*T)", "x": "K*w**3 - o"},
        "outputs": {"y": "x"},
        "initial": {"w": 0, "x": 0},
        "solver": {"method": "rk4", "step": "sample"},
    }
    fine = {**stiff, "solver": {"method": "rk4", "step": "sample", "substeps": 40}}
    true = Problem.build(load_model(fine), [make_record(np.zeros(N))])
    y = true.predict(np.array([[K, 3.0, 1.0]]))[0]
    y = y + 1e-5 * np.random.default_rng(1).standard_normal(y.size)
    auto, white, ar1 = (identify_plant(stiff, y, loss) for loss in (AUTO, WHITE, AR1))
    assert not ar1.correlation_times  # nothing of the step is left in the residuals
    assert same(auto, white)
    assert auto.warnings == white.warnings
    assert auto.substeps > 1
    assert any("the integration step of the model, substeps: 1" in text for text in auto.warnings)


@pytest.mark.parametrize("most", [130, 160, 300])
def test_a_budget_that_does_not_suffice_leaves_squares(most: int) -> None:
    tight = replace(SMALL, stop=Stop(evaluations=most, settled=None))
    auto, white = (
        identify_plant(TANK, simulate_disturbed(2), loss, settings=tight) for loss in (AUTO, WHITE)
    )
    assert [one.value for one in auto.parameters] == [one.value for one in white.parameters]
    assert [one.stderr for one in auto.parameters] == [one.stderr for one in white.parameters]
    assert auto.evaluations <= most


@pytest.mark.parametrize(
    "options",
    [
        {"prediction": "one-step"},
        {"settings": replace(SMALL, method="simple")},
        {"settings": replace(SMALL, refine=False)},
    ],
)
def test_what_has_no_noise_model_is_as_with_white(options: dict[str, Any]) -> None:
    auto, white = (
        identify_plant(TANK, simulate_disturbed(2), loss, **options) for loss in (AUTO, WHITE)
    )
    assert same(auto, white)
    assert auto.warnings == white.warnings


def test_a_robust_loss_stays_without_noise_model() -> None:
    y = simulate_disturbed(2)
    auto, white = (
        identify_plant(TANK, y, Loss("soft-l1", 0.1, name)) for name in ("auto", "white")
    )
    assert same(auto, white)


def test_profiles_are_of_squares_whatever_was_chosen() -> None:
    y = simulate_disturbed(2)
    told = []
    for loss in (AUTO, WHITE):
        problem = Problem.build(load_model(TANK), [make_record(y)], loss=loss)
        told.append(compute_profile(problem, np.array([K, OFFSET]), "K", 5))
    assert told[0].estimate == told[1].estimate
    assert told[0].interval == told[1].interval
