"""The hold that suits an input is chosen by its values."""

import numpy as np
import pytest

from sysid.core.types import FloatArray
from sysid.data.holds import choose_hold
from sysid.data.records import Channel, Hold

RNG = np.random.default_rng(14)
N = 1000
PHASE = np.linspace(0, 1, N)
SLOW = 20 + 3 * np.sin(2 * np.pi * 2 * PHASE)


def dwell(levels: FloatArray, least: int, most: int) -> FloatArray:
    """Levels one after the other, each for some samples."""
    return np.repeat(levels, RNG.integers(least, most + 1, levels.size))


PULSE = np.where((np.arange(N) >= 300) & (np.arange(N) < 340), 5.0, 0.0)

HELD: dict[str, FloatArray] = {
    "heater steps": np.repeat(RNG.uniform(0, 60, 20), 60),
    "heater steps of whole percents": np.repeat(np.round(RNG.uniform(0, 60, 20)), 60),
    "a binary signal that may change at every sample": RNG.choice([-1.0, 1.0], N),
    "a slower binary signal": np.repeat(RNG.choice([-1.0, 1.0], N // 7), 7),
    "a ternary signal that may change at every sample": RNG.choice([-1.0, 0.0, 1.0], N),
    "valve commands": dwell(RNG.choice([0.0, 25.0, 50.0, 75.0, 100.0], 40), 5, 40),
    "a staircase": np.repeat([0.0, 10.0, 20.0, 30.0, 20.0, 10.0], 100),
    "one step": np.where(PHASE < 0.5, 0.0, 0.3),
    "a pulse": PULSE,
    "a pulse of one sample": np.eye(1, N, 500)[0],
    "a slower controller": np.repeat(RNG.standard_normal(100), 10),
    "steps of few samples": dwell(RNG.uniform(0, 1, 300), 1, 4),
}
MOVING: dict[str, FloatArray] = {
    "a sine": np.sin(40 * PHASE),
    "a ramp": PHASE,
    "a quantised ramp": np.round(PHASE, 2),
    "a quantised sine": np.round(np.sin(2 * np.pi * 3 * PHASE), 1),
    "a slow measured signal": np.round(SLOW, 1),
    "a slow measured signal with noise": np.round(SLOW + RNG.normal(0, 0.05, N), 1),
    "a slow measured signal of few levels": np.round(20 + 0.3 * PHASE + RNG.normal(0, 0.02, N), 1),
    "noise of a converter": np.round(RNG.normal(0, 2, N)),
    "a measured pulse": np.round(1000 * np.exp(-((PHASE - 0.3) ** 2) / 1e-4)),
    "a ramp between rests": np.clip(10 * PHASE - 4, 0, 1),
    "noisy steps": np.repeat(RNG.uniform(0, 60, 20), 50) + RNG.normal(0, 0.01, N),
    "a constant": np.full(N, 3.0),
}


@pytest.mark.parametrize("kind", HELD)
def test_piecewise_constant_inputs_are_held(kind: str) -> None:
    assert choose_hold(HELD[kind]).hold == "zero"


@pytest.mark.parametrize("kind", MOVING)
def test_moving_inputs_are_straight_lines(kind: str) -> None:
    assert choose_hold(MOVING[kind]).hold == "first"


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, -1000.0])
def test_unit_and_offset_do_not_matter(scale: float, offset: float) -> None:
    for signals, hold in ((HELD, "zero"), (MOVING, "first")):
        for values in signals.values():
            assert choose_hold(scale * values + offset * scale).hold == hold


def test_rounding_is_no_movement() -> None:
    rounding = 1e-12 * RNG.standard_normal(N)
    assert choose_hold(np.repeat(RNG.uniform(0, 60, 20), 50) + rounding).hold == "zero"


def test_missing_values_do_not_count() -> None:
    values = HELD["heater steps"].copy()
    values[5:9] = np.nan
    assert choose_hold(values).hold == "zero"
    assert choose_hold(np.full(5, np.nan)).hold == "first"


@pytest.mark.parametrize("hold", ["zero", "first", "band-limited"])
def test_a_given_hold_is_kept(hold: Hold) -> None:
    times = np.arange(float(N))
    assert Channel("u", times, MOVING["a sine"], hold=hold).effective_hold == hold
    assert Channel("u", times, PULSE, hold=hold).effective_hold == hold


def test_the_history_counts() -> None:
    times = np.arange(float(N))
    late = Channel("u", times, HELD["heater steps"][:N]).slice_with_history(900.0, 999.0)
    assert late.effective_hold == "zero"
