"""Whether a model forgets where it began, and the noise model that is chosen by it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sysid.core.settings import GeneticAlgorithm, Loss, Stop
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.identification.noise_model_choice import find_integrating_outputs, is_ar1_indicated
from sysid.identification.result import Identification
from sysid.models.catalogue.load import load_model
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate
from sysid.uncertainty.profile_likelihood import compute_profile
from tests.unit.sysid.residuals.test_coloured import coloured

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


def signal(seed: int = 1, n: int = N) -> FloatArray:
    return np.repeat(np.random.default_rng([seed, 1]).choice([-1.0, 2.0], n // 10), 10)


def record(y: FloatArray, u: FloatArray | None = None) -> Record:
    times = STEP * np.arange(y.size)
    u = signal(n=y.size) if u is None else u
    return Record((Channel("u", times, u),), (Channel("y", times, y),))


def plant(rate: float, disturbance: FloatArray) -> FloatArray:
    """x' = K u - o - rate x + disturbance, from 0 on."""
    u, x = signal(n=disturbance.size), np.zeros(disturbance.size)
    for k in range(1, x.size):
        gain = rate if rate > 0 else 1.0
        flow = gain * (K * u[k - 1] - OFFSET) - rate * x[k - 1]
        x[k] = x[k - 1] + STEP * (flow + disturbance[k - 1])
    return x


def disturbed(seed: int, rate: float = 0.0) -> FloatArray:
    """Output of the plant under a random inflow."""
    return plant(rate, coloured(N, 0.5, seed)) + 0.01 * coloured(N, 0.0, seed + 100)


def found(model: dict[str, Any], y: FloatArray, loss: Loss, **options: Any) -> Identification:
    settings = options.pop("settings", SMALL)
    return identify(load_model(model), record(y), settings, loss=loss, **options)


def same(one: Identification, other: Identification) -> bool:
    """Whether all numbers of two results are equal, bit for bit."""
    return (
        one.estimates == other.estimates
        and (one.rms, one.criteria) == (other.rms, other.criteria)
        and one.evaluations == other.evaluations
        and one.correlation_times == other.correlation_times
        and one.residual_tests == other.residual_tests
    )


def remembers(model: dict[str, Any], theta: tuple[float, ...], n: int = N, **options: Any) -> bool:
    rows = [record(plant(0.0, np.zeros(n)))] * options.pop("experiments", 1)
    problem = Problem.build(load_model(model), rows, **options)
    return find_integrating_outputs(problem, np.array(theta)) == {"y"}


STARTS: list[tuple[dict[str, Any], tuple[float, ...], dict[str, Any]]] = [
    ({"x": 0}, (), {}),
    ({"x": "measured"}, (), {}),
    ({"x": {"lower": -1, "upper": 1}}, (0.1,), {}),
    ({"x": {"lower": -1, "upper": 1}}, (0.1, 0.2), {"experiments": 2}),
    ({"x": {"lower": -1, "upper": 1}}, (), {"parameters": {"x(0)": {"fixed": 0.1}}}),
]


@pytest.mark.parametrize(("initial", "more", "options"), STARTS)
def test_an_integrator_remembers_its_start_and_a_lag_does_not_however_it_is_given(
    initial: dict[str, Any], more: tuple[float, ...], options: dict[str, Any]
) -> None:
    assert remembers({**TANK, "initial": initial}, (K, OFFSET, *more), **options)
    assert not remembers({**LAG, "initial": initial}, (K, OFFSET, *more), **options)


@pytest.mark.parametrize(
    ("part", "expected"), [(0.1, False), (0.25, False), (0.5, True), (3.0, True)]
)
def test_a_lag_is_forgotten_within_a_record_that_is_long_beside_it(
    part: float, expected: bool
) -> None:
    model = {**LAG, "constants": {"T": part * STEP * N}}
    assert remembers(model, (K, OFFSET)) is expected


def test_a_short_experiment_beside_a_long_one_makes_no_lag_an_integrator() -> None:
    """Of a fifth of the length: by itself it ends before the lag has forgotten its start."""
    lag = load_model({**LAG, "constants": {"T": 0.1 * STEP * N}})
    both = [record(plant(0.0, np.zeros(n))) for n in (N, N // 5)]
    theta = np.array([K, OFFSET])
    assert [find_integrating_outputs(Problem.build(lag, [one]), theta) for one in both] == [
        set(),
        {"y"},
    ]
    for records in (both, both[::-1]):
        assert find_integrating_outputs(Problem.build(lag, records), theta) == set()
        assert find_integrating_outputs(Problem.build(load_model(TANK), records), theta) == {"y"}


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_forgetting_does_not_depend_on_the_states_units(unit: float) -> None:
    hidden = {"states": {"w": "1", "x": "1"}, "initial": {"w": 0, "x": 0}}
    chain = {
        "w": f"w(k-1) + h*({unit}*(K*u(k-1) - o))",
        "x": f"x(k-1) + h*(w(k-1)/{unit} - x(k-1))/T",
    }
    slow = {**LAG, **hidden, "equations": chain}
    fast = {**slow, "equations": {**chain, "w": f"w(k-1) + h*({unit}*(K*u(k-1) - o) - w(k-1))/T"}}
    assert remembers(slow, (K, OFFSET))
    assert not remembers(fast, (K, OFFSET))


def test_a_recursion_that_reads_two_samples_remembers_by_its_poles() -> None:
    double = {**TANK, "equations": {"x": "2*x(k-1) - x(k-2) + h**2*(K*u(k-1) - o)"}}
    damped = {**TANK, "equations": {"x": "1.4*x(k-1) - 0.5*x(k-2) + h**2*(K*u(k-1) - o)"}}
    for initial in (0, "measured"):
        assert remembers({**double, "initial": {"x": initial}}, (K, OFFSET))
        assert not remembers({**damped, "initial": {"x": initial}}, (K, OFFSET))
    second = {**TANK, "equations": {"x": "x(k-1) + min(0, abs(x(k-2))) + h*(K*u(k-1) - o)"}}
    assert remembers({**second, "initial": {"x": "measured"}}, (K, OFFSET))


def test_a_drive_with_dry_friction_remembers_where_it_is() -> None:
    assert find_integrating_outputs(
        Problem.build(load_model("emps"), [record(plant(0.0, np.zeros(N)))]),
        np.array([90.0, 200.0, 20.0, -3.0]),
    ) == {"y"}


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_in_an_integrator_drifts_are_taken_for_noise_and_squares_are_told(seed: int) -> None:
    y = disturbed(seed)
    auto, white, ar1 = (found(TANK, y, loss) for loss in (AUTO, WHITE, AR1))
    assert auto.noise_model == "ar1"
    assert same(auto, ar1)
    assert not same(auto, white)
    (note,) = set(auto.warnings) - set(ar1.warnings)
    assert "noise_model: white" in note
    for one in white.estimates:
        assert f"{one.name} = {one.value:.4g}" in note
    assert f"RMS {white.rms:.4g}" in note


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_where_the_model_forgets_squares_stay_whatever_the_colour(seed: int) -> None:
    y = disturbed(seed, 1.0 / T)
    auto, white, ar1 = (found(LAG, y, loss) for loss in (AUTO, WHITE, AR1))
    assert ar1.correlation_times["y"] > 0
    assert same(auto, white)
    assert auto.warnings == white.warnings
    assert auto.noise_model == "white"


@pytest.mark.parametrize("model", [TANK, LAG])
@pytest.mark.parametrize("sd", [0.0, 1e-9, 0.05])
def test_white_noise_and_no_noise_change_nothing(model: dict[str, Any], sd: float) -> None:
    rate = 0.0 if model is TANK else 1.0 / T
    y = plant(rate, np.zeros(N)) + sd * coloured(N, 0.0, 7)
    auto, white = (found(model, y, loss) for loss in (AUTO, WHITE))
    assert same(auto, white)
    assert auto.warnings == white.warnings


def test_a_drift_as_slow_as_the_record_is_left_to_squares() -> None:
    leak = plant(0.02, np.zeros(N))  # one that the model lacks
    auto, white, ar1 = (found(TANK, leak, loss) for loss in (AUTO, WHITE, AR1))
    assert ar1.correlation_times["y"] > STEP * N / 5
    assert auto.estimates == white.estimates
    (note,) = set(auto.warnings) ^ set(white.warnings)
    assert note.startswith("noise_model auto keeps least squares")
    assert f"a correlation time of y {ar1.correlation_times['y']:.3g} s" in note


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
    true = Problem.build(load_model(fine), [record(np.zeros(N))])
    y = true.predict(np.array([[K, 3.0, 1.0]]))[0]
    y = y + 1e-5 * np.random.default_rng(1).standard_normal(y.size)
    auto, white, ar1 = (found(stiff, y, loss) for loss in (AUTO, WHITE, AR1))
    assert not ar1.correlation_times  # nothing of the step is left in the residuals
    assert same(auto, white)
    assert auto.warnings == white.warnings
    assert auto.substeps > 1
    assert any("the integration step of the model, substeps: 1" in text for text in auto.warnings)


@pytest.mark.parametrize("most", [130, 160, 300])
def test_a_budget_that_does_not_suffice_leaves_squares(most: int) -> None:
    tight = replace(SMALL, stop=Stop(evaluations=most, settled=None))
    auto, white = (found(TANK, disturbed(2), loss, settings=tight) for loss in (AUTO, WHITE))
    assert auto.estimates == white.estimates
    assert auto.warnings == white.warnings
    assert auto.evaluations <= most


@pytest.mark.parametrize(("most", "expected"), [(None, True), (1000, True), (9, False)])
def test_a_time_that_leaves_no_room_for_the_look_leaves_squares(
    most: int | None, expected: bool
) -> None:
    """Simulations of a long record: of each state eight, and two for the colour."""
    problem = Problem.build(load_model(TANK), [record(disturbed(2))])
    theta = np.array([one.value for one in found(TANK, disturbed(2), WHITE).estimates])
    assert is_ar1_indicated(problem, theta, analyse_estimate(problem, theta), most) is expected


@pytest.mark.parametrize(
    "options",
    [
        {"prediction": "one-step"},
        {"settings": replace(SMALL, method="simple")},
        {"settings": replace(SMALL, refine=False)},
    ],
)
def test_what_has_no_noise_model_is_as_with_white(options: dict[str, Any]) -> None:
    auto, white = (found(TANK, disturbed(2), loss, **options) for loss in (AUTO, WHITE))
    assert same(auto, white)
    assert auto.warnings == white.warnings


def test_a_robust_loss_stays_without_noise_model() -> None:
    y = disturbed(2)
    auto, white = (found(TANK, y, Loss("soft-l1", 0.1, name)) for name in ("auto", "white"))
    assert same(auto, white)


def test_profiles_are_of_squares_whatever_was_chosen() -> None:
    y = disturbed(2)
    told = []
    for loss in (AUTO, WHITE):
        problem = Problem.build(load_model(TANK), [record(y)], loss=loss)
        told.append(compute_profile(problem, np.array([K, OFFSET]), "K", 5))
    assert told[0].estimate == told[1].estimate
    assert told[0].interval == told[1].interval


@pytest.mark.parametrize(("damping", "period"), [(0.0, 2.0), (0.02, 2.0)])
def test_an_oscillation_that_goes_on_is_no_drift(damping: float, period: float) -> None:
    pole = np.exp((-damping + 2j * np.pi / period) * STEP)
    swing = f"{2 * pole.real}*x(k-1) - {abs(pole) ** 2}*x(k-2) + h**2*(K*u(k-1) - o)"
    assert not remembers({**TANK, "equations": {"x": swing}}, (K, OFFSET))
    both = {
        **TANK,
        "states": {"w": "1", "x": "1"},
        "initial": {"w": 0, "x": 0},
        "equations": {"x": swing, "w": "w(k-1) + h*x(k-1)"},
        "outputs": {"y": "w"},
    }
    assert remembers(both, (K, OFFSET))
