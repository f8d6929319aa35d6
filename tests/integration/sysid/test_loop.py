"""Records of a controller: the command is read held, and noise is looked for inside the plant."""

import numpy as np
import pytest

from sysid.core.errors import InvalidSettings
from sysid.core.settings import GeneticAlgorithm, Loss
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.judgement.levels import STRONG_ODDS
from sysid.judgement.noise_sources import compute_response_gain
from sysid.judgement.residual_context import Simulations
from sysid.models.catalogue.load import load_model
from sysid.results.identification import Identification
from sysid.simulation.problem import Problem

PERIOD, LAG = 0.25, 4.25
TRUTH = {"K": 2.0, "T": 12.3, "L": LAG}
SMALL = GeneticAlgorithm(population=24, generations=20)


def make_loop(load: float = 0.1, seed: int = 1, samples: int = 1200, wish: float = 1.0) -> Record:
    """First order with a dead time, a load at its input, and a PI controller with set points."""
    random = np.random.default_rng(seed)
    wishes = wish * np.repeat([0.0, 1.0, -1.0, 1.0, -1.0, 1.0, 0.0, 1.0], 150)[:samples]
    keep, decay = np.exp(-PERIOD / TRUTH["T"]), np.exp(-PERIOD / 50.0)
    x, d, total = 0.0, load * random.normal(), 0.0
    u, y = np.empty(samples), np.empty(samples)
    for k in range(samples):
        y[k] = x + 0.02 * random.normal()
        error = wishes[k] - y[k]
        total += 0.35 * PERIOD / 12.3 * error
        u[k] = 0.35 * error + total
        x = keep * x + 2.0 * (1 - keep) * (u[max(k - round(LAG / PERIOD), 0)] + d)
        d = decay * d + load * np.sqrt(1 - decay**2) * random.normal()
    return build(u, y)


def build(u: FloatArray, y: FloatArray) -> Record:
    times = PERIOD * np.arange(u.size)
    return Record((Channel("u", times, u),), (Channel("y", times, y + 20.0),))


def test_a_command_is_recognised_and_read_held() -> None:
    found = identify("fopdt", make_loop())
    assert found.commands == ("u",)
    (hold,) = found.input_hold
    assert (hold.chosen, hold.other) == ("zero", None)
    assert found.noise_model == "load"
    for name, true in TRUTH.items():
        low, high = found[name].interval95 or (np.nan, np.nan)
        assert low <= true <= high, name
    (told,) = [one for one in found.findings if one.explanation == "closed loop"]
    assert told.severity == "note"
    assert "hold={'u': 'first'}" in " ".join(found.warnings) or "hold: {u: first}" in told.text
    assert found.verdict.trust == "trustworthy"


def test_a_loop_may_be_declared_or_denied() -> None:
    record = make_loop()
    asked = identify("fopdt", record, commands=["u"])
    assert asked.commands == ("u",)
    assert asked["L"].value == pytest.approx(LAG, abs=0.15)
    assert not [one for one in asked.findings if one.explanation == "closed loop"]
    denied = identify("fopdt", record, commands=[])
    assert denied.commands == ()
    assert denied.input_hold[0].chosen == "first"
    assert not [one for one in denied.findings if one.explanation in ("closed loop", "feedback")]


def test_a_loop_that_only_a_load_moves_tells_nothing_of_the_plant() -> None:
    still = make_loop(load=0.3, wish=0.0)
    found = identify("fopdt", still, commands=["u"], loss=Loss(noise_model="load"))
    gain = compute_gain(found, still)
    assert gain < STRONG_ODDS
    assert all(found[name].status != "identified" for name in TRUTH)
    assert compute_gain(identify("fopdt", make_loop()), make_loop()) > 50.0


def compute_gain(found: Identification, record: Record) -> float:
    loss = Loss(noise_model="load")
    problem = Problem.build(load_model("fopdt"), [record], loss=loss, initial="rest")
    problem = problem.rebuild(commands=("u",))
    theta = np.array([found[name].value for name in problem.free_names])
    gain = compute_response_gain(problem, theta, Simulations())
    assert gain is not None
    return gain


def test_a_given_hold_wins_over_a_command() -> None:
    problem = Problem.build(load_model("fopdt"), [make_loop()])
    held = problem.rebuild(commands=("u",))
    assert held.records[0].inputs[0].hold == "zero"
    given = problem.records[0].replace_holds({"u": "first"})
    assert problem.rebuild(records=[given], commands=("u",)).records[0].inputs[0].hold == "first"


def test_a_command_is_an_input_of_the_model() -> None:
    with pytest.raises(InvalidSettings, match="model 'fopdt' has no input 'v'"):
        identify("fopdt", make_loop(), SMALL, commands=["v"])
    with pytest.raises(InvalidSettings, match="a list of inputs"):
        identify("fopdt", make_loop(), SMALL, commands="u")  # type: ignore[arg-type]


def test_an_open_loop_in_straight_lines_stays_so() -> None:
    random = np.random.default_rng(3)
    u = np.cumsum(random.normal(size=600))
    u = 0.1 * np.convolve(u, np.ones(20) / 20, mode="same")
    between = 0.5 * (u[1:] + u[:-1])
    x, y = 0.0, np.empty(600)
    keep, delay = np.exp(-PERIOD / 12.3), round(LAG / PERIOD)
    for k in range(600):
        y[k] = x + 0.02 * random.normal()
        x = keep * x + 2.0 * (1 - keep) * between[max(min(k, 598) - delay, 0)]
    found = identify("fopdt", build(u, y))
    assert found.commands == ()
    assert found.input_hold[0].chosen == "first"


def test_validation_and_saved_values_know_the_command() -> None:
    found = identify("fopdt", make_loop(), validation_fraction=0.3)
    asked = identify("fopdt", make_loop(), validation_fraction=0.3, commands=["u"])
    assert found.commands == ("u",)
    assert found.rms_validation == pytest.approx(asked.rms_validation, rel=1e-2)


def test_white_residuals_of_a_loop_tell_the_command_too() -> None:
    found = identify("fopdt", make_loop(load=0.0), loss=Loss(noise_model="white"))
    assert found.commands == ("u",)
    assert found["L"].value == pytest.approx(LAG, abs=0.1)
