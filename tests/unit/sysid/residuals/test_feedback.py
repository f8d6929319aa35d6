"""An input that a controller makes from the output is recognised; one of an open loop is not."""

from collections.abc import Callable
from typing import Literal

import numpy as np
import pytest

from sysid import Channel, Record, identify, load_model
from sysid.core.settings import Loss
from sysid.core.types import FloatArray
from sysid.residuals.feedback import compute_explained_share, describe_feedback
from sysid.residuals.residual_tests import ResidualSeries

N, STEP, LATE = 1500, 0.1, 20  # samples, s, samples of dead time
TIMES = STEP * np.arange(N)


def simulate_loop(
    seed: int, reference: FloatArray, quantum: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Input and output of K = 2, T = 8 s, L = 2 s under PI control with a slow disturbance."""
    draws = np.random.default_rng(seed)
    keep, state, total, slow = np.exp(-STEP / 8.0), 0.0, 0.0, 0.0
    u, y = np.zeros(N), np.zeros(N)
    for k in range(N):
        slow = 0.97 * slow + draws.normal(0, 0.15)
        y[k] = state + slow + draws.normal(0, 0.05)
        total += STEP * (reference[k] - y[k])
        u[k] = 1.2 * (reference[k] - y[k]) + 0.15 * total
        if quantum:
            u[k] = quantum * np.round(u[k] / quantum)
        state = keep * state + (1 - keep) * 2.0 * (u[k - LATE] if k >= LATE else 0.0)
    return u, y


def make_held_input(u: FloatArray) -> Channel:
    return Channel("u", TIMES, u, hold="zero")


def series(residual: FloatArray, hidden: int | None = None) -> ResidualSeries:
    scored = np.ones(N, dtype=np.bool_)
    if hidden is not None:
        scored[hidden::37] = False
    return ResidualSeries(0, "y", TIMES, residual, scored, 1.0, ())


def simulate_free_run(u: FloatArray, gain: float = 2.0) -> FloatArray:
    """Free run of the plant with a given gain."""
    keep, y = np.exp(-STEP / 8.0), np.zeros(N)
    for k in range(1, N):
        past = u[k - 1 - LATE] if k > LATE else 0.0
        y[k] = keep * y[k - 1] + (1 - keep) * gain * past
    return y


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("quantum", [0.0, 0.1])
@pytest.mark.parametrize("height", [0.0, 5.0])
@pytest.mark.parametrize("gain", [2.0, 1.0])
def test_a_loop_is_recognised_with_and_without_reference_and_with_a_poor_model(
    seed: int, quantum: float, height: float, gain: float
) -> None:
    u, y = simulate_loop(seed, height * ((TIMES // 15) % 2), quantum)
    assert compute_explained_share(series(y - simulate_free_run(u, gain)), make_held_input(u)) > 0.8
    assert (
        compute_explained_share(
            series(y - simulate_free_run(u, gain), hidden=5), make_held_input(u)
        )
        > 0.8
    )


def make_wave(of: Callable[[FloatArray, np.random.Generator], FloatArray], seed: int) -> FloatArray:
    return of(TIMES, np.random.default_rng(seed))


INPUTS: dict[str, Callable[[FloatArray, np.random.Generator], FloatArray]] = {
    "sine": lambda t, _: np.sin(t),
    "square": lambda t, _: np.sign(np.sin(2 * np.pi * t / 6)),
    "multisine": lambda t, _: sum(
        (np.cos(2 * np.pi * k * t / 40 + k * k) for k in range(1, 41)), np.zeros(t.size)
    ),
    "chirp": lambda t, _: np.sin(0.05 * t**2),
    "trapezium": lambda t, _: np.clip(3 * np.sin(2 * np.pi * t / 17), -1, 1),
    "binary": lambda t, g: np.repeat(g.choice([-1.0, 1.0], t.size // 8 + 1), 8)[: t.size],
    "white": lambda t, g: g.normal(size=t.size),
    "filtered": lambda t, g: np.convolve(g.normal(size=t.size), np.ones(10) / 10, "same"),
    "walk": lambda t, g: np.cumsum(g.normal(size=t.size)),
}


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("noise", [0.0, 0.3])
@pytest.mark.parametrize("hold", ["zero", "first"])
def test_an_open_loop_is_not_taken_for_one_however_poor_the_model(
    name: str, noise: float, hold: Literal["zero", "first"]
) -> None:
    for seed in range(3):
        u = make_wave(INPUTS[name], seed)
        draws = np.random.default_rng(seed + 9)
        misfit = (
            simulate_free_run(u)
            - simulate_free_run(u, gain=1.0) ** 2
            + noise * np.std(u) * draws.normal(size=N)
        )
        assert compute_explained_share(series(misfit), Channel("u", TIMES, u, hold=hold)) < 0.3


def test_too_short_constant_and_irregular_records_are_not_judged() -> None:
    u, y = simulate_loop(0, np.zeros(N))
    judged = series(y - simulate_free_run(u))
    assert compute_explained_share(judged, make_held_input(np.ones(N))) == 0.0
    assert compute_explained_share(judged._replace(residual=np.zeros(N)), make_held_input(u)) == 0.0
    short = judged.scored & (TIMES < 5.0)
    assert compute_explained_share(judged._replace(scored=short), make_held_input(u)) == 0.0
    uneven = TIMES + 0.04 * np.random.default_rng(0).random(N)
    assert compute_explained_share(judged._replace(times=uneven), make_held_input(u)) == 0.0


@pytest.mark.parametrize(("closed", "least", "most"), [("first", 0.0, 0.3), ("last", 0.9, 1.0)])
def test_of_a_long_record_the_last_5_000_samples_are_judged(
    closed: str, least: float, most: float
) -> None:
    n = 10_000
    draw, times = np.random.default_rng(4), STEP * np.arange(10_000)
    residual = draw.normal(size=n)
    follows = -residual - 0.5 * np.concatenate([[0.0], residual[:-1]])
    in_loop = times < times[n // 2] if closed == "first" else times >= times[n // 2]
    u = np.where(in_loop, follows, 0.0) + np.where(in_loop, 0.01, 1.0) * draw.normal(size=n)
    long = ResidualSeries(0, "y", times, residual, np.ones(n, dtype=np.bool_), 1.0, ())
    assert least <= compute_explained_share(long, Channel("u", times, u, hold="zero")) <= most


def test_a_regulated_record_without_reference_is_warned_of() -> None:
    u, y = simulate_loop(1, np.zeros(N))
    record = Record((make_held_input(u),), (Channel("y", TIMES, y),))

    for options in ({}, {"loss": Loss(noise_model="ar1")}):
        found = identify(load_model("fopdt"), [record], seed=1, **options)
        [loop] = [one for one in found.findings if one.explanation == "feedback"]
        assert loop.text.startswith("input 'u' follows the residuals of y: they explain")
        assert loop.severity == "caution"
        assert loop.parameters == tuple(one.name for one in found.parameters)
        assert found.verdict.trust == "not trustworthy"
        assert not any(one.status == "identified" for one in found.parameters)
    assert describe_feedback([]) == []


def test_what_a_model_misses_of_an_input_read_as_straight_is_told_as_another_cause() -> None:
    u = make_wave(INPUTS["filtered"], 0)
    keep, y = np.exp(-STEP / 0.3), np.zeros(N)
    for k in range(1, N):  # an open loop: straight from sample to sample, and no dead time
        y[k] = keep * y[k - 1] + (1 - keep) * 0.5 * (u[k] + u[k - 1])
    straight, stepped = (
        describe_feedback([series(y)._replace(inputs=(Channel("u", TIMES, u, hold=hold),))])
        for hold in ("first", "zero")
    )
    assert "misses part of the response within a sample" in straight[0]
    assert not any("within a sample" in one for one in stepped)
