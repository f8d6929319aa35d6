"""What left residuals that are not noise is told by likelihood, each from all others."""

import numpy as np
import pytest
from scipy.signal import lfilter
from sysid.judgement.suspects import describe_suspects, find_suspects

from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.models.parse import parse_model
from sysid.residuals.whitening import Whitening
from sysid.search.refine import refine_candidates
from sysid.simulation.problem import Problem
from sysid.uncertainty.analysis import analyse_estimate
from tests.support.library.small_models import LINE
from tests.support.profiles import draw_seeds

N, NOISE = 300, 0.05
TIMES = 0.2 * np.arange(N)
MODEL = parse_model(LINE)


def draw_fault(kind: str, random: np.random.Generator) -> FloatArray:
    """What is added to the output; noise by itself if it is none of these."""
    first, fault = int(random.integers(60, 200)), NOISE * random.standard_normal(N)
    if kind == "slow noise":
        return 0.2 * np.asarray(lfilter([np.sqrt(0.19)], [1, -0.9], random.normal(size=N)))
    shapes = {
        "a drift": 0.4 * TIMES / TIMES[-1],
        "a step disturbance": 0.3 * (np.arange(N) > first),
        "a disturbance": 0.4 * ((np.arange(N) >= first) & (np.arange(N) < first + 40)),
        "a wrong start": 1.5 * np.exp(-TIMES),
        "outliers": 2.0 * (np.arange(N) == first),
    }
    return np.asarray(fault + shapes.get(kind, 0.0))


def draw_output(kind: str, seed: int) -> tuple[FloatArray, FloatArray]:
    """Input and output of the line with one fault."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.uniform(-1, 1, N // 10), 10)
    response = lfilter([0.2], [1, -0.8], u) if kind == "dynamics that the model lacks" else u
    y = 1.0 + 2.0 * np.asarray(response) + draw_fault(kind, random)
    if kind == "a sensor that is stuck":
        first = int(random.integers(60, 200))
        y[first : first + 40] = y[first]
    return u, np.minimum(y, 1.8) if kind == "a sensor at its limit" else y


def name_suspects(kind: str, seed: int, *, are_white: bool = False) -> list[str]:
    return list_suspects(*draw_output(kind, seed), are_white=are_white)


def list_suspects(
    u: FloatArray, y: FloatArray, *, are_white: bool = False, whitening: Whitening | None = None
) -> list[str]:
    record = Record((Channel("u", TIMES, u),), (Channel("y", TIMES, y),))
    problem = Problem.build(MODEL, [record])
    end = refine_candidates(problem, [np.array([1.0, 0.5])])[0]
    assert end is not None
    analysis = analyse_estimate(problem, end.theta, whitening=whitening)
    suspects = find_suspects(problem, analysis, are_white=are_white)
    if suspects:
        assert suspects[0].name in describe_suspects(suspects)
    return [one.name for one in suspects]


@pytest.mark.parametrize(
    "kind",
    [
        "a drift",
        "a step disturbance",
        "a disturbance",
        "a wrong start",
        "outliers",
        "slow noise",
        "dynamics that the model lacks",
        "a sensor at its limit",
        "a sensor that is stuck",
    ],
)
def test_the_fault_is_named_first(kind: str) -> None:
    for seed in draw_seeds(gate=4, night=40):
        assert name_suspects(kind, seed)[0].startswith(kind)


def test_nothing_is_suspected_of_white_noise() -> None:
    for seed in draw_seeds(gate=6, night=60):
        assert name_suspects("", seed) == []


def test_of_white_residuals_only_single_values_are_suspected() -> None:
    assert name_suspects("a drift", 1, are_white=True) == []
    assert name_suspects("outliers", 1, are_white=True)[0].startswith("outliers of y")


def test_coarse_readings_at_rest_are_not_stuck() -> None:
    u = np.repeat([0.0, 1.0, -0.5], N // 3)
    coarse = np.round(1.0 + 2.0 * u + draw_fault("slow noise", np.random.default_rng(2)), 1)
    assert not any("stuck" in name for name in list_suspects(u, coarse))


def test_beside_a_noise_model_only_what_the_measurement_shows_is_named() -> None:
    whitening = Whitening(np.where(np.arange(N) > 0, 0.9, 0.0), 1)
    u, stuck = draw_output("a sensor that is stuck", 3)
    (name,) = list_suspects(u, stuck, whitening=whitening)
    assert name.startswith("a sensor that is stuck: y repeats its value in 40 samples")
    assert list_suspects(*draw_output("slow noise", 3), whitening=whitening) == []


def test_inputs_and_outputs_that_never_move_are_no_suspects() -> None:
    random = np.random.default_rng(1)
    slow = np.asarray(lfilter([0.1], [1, -0.95], random.normal(size=N)))
    assert list_suspects(np.ones(N), 1.0 + slow)[0].startswith("slow noise")
    assert not any("limit" in name for name in list_suspects(slow, np.full(N, 50.0)))
