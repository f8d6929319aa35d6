"""The gas-dynamic tube: against the exact linear solution, and laws that it must keep."""

from typing import Any

import numpy as np
import pytest
from scipy.special import ive

from service.plants.tube import (
    GAS_CONSTANT,
    HEAT_CAPACITY_RATIO,
    PRANDTL,
    VISCOSITY,
    Tube,
    add_gauge_errors,
    build_excitation,
    simulate_tube,
    simulate_tube_record,
)
from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.records import Channel

PERIOD = 1e-3
AMBIENT = 1e5


def build_linear(tube: Tube, inlet: FloatArray) -> FloatArray:
    """Far end of a tube after small changes at its inlet: Bessel functions, by FFT.

    G = 1/(cosh Γ + Z_c (sV/nP₀) sinh Γ); the gas in the volume exchanges heat with its walls, so
    its exponent n goes from 1 (slow) to γ (quick).
    """
    s = 2j * np.pi * np.fft.rfftfreq(inlet.size, PERIOD)
    s[0] = 1e-9
    density, radius = AMBIENT / (GAS_CONSTANT * tube.temperature), tube.bore_m / 2
    area, speed = np.pi * radius**2, np.sqrt(HEAT_CAPACITY_RATIO * GAS_CONSTANT * tube.temperature)
    z = radius * np.sqrt(s * density / VISCOSITY)
    warm = z * np.sqrt(PRANDTL)
    series = density * s / area * ive(0, z) / ive(2, z)
    shunt = area * s / (density * speed**2)
    shunt = shunt * (1 + (HEAT_CAPACITY_RATIO - 1) * 2 * ive(1, warm) / (warm * ive(0, warm)))
    along, impedance = tube.length_m * np.sqrt(series * shunt), np.sqrt(series / shunt)
    volume = tube.volume_m3
    loss = (
        20
        * 4.84
        * volume ** (2 / 3)
        * (HEAT_CAPACITY_RATIO - 1)
        / (density * volume * GAS_CONSTANT)
    )
    exponent = (HEAT_CAPACITY_RATIO * s + loss) / (s + loss)
    end = impedance * s * volume / (exponent * AMBIENT)
    return np.fft.irfft(np.fft.rfft(inlet) / (np.cosh(along) + end * np.sinh(along)), inlet.size)


def make_pressure(values: FloatArray, period: float = PERIOD) -> Channel:
    return Channel("P1", period * np.arange(values.size), values, "Pa")


@pytest.mark.slow
def test_a_small_step_comes_through_as_the_linear_theory_says() -> None:
    times = PERIOD * np.arange(16_000)

    def ramp(since: float) -> FloatArray:
        return 0.5 - 0.5 * np.cos(np.pi * np.clip((times - since) / 0.02, 0, 1))

    inlet = ramp(0.1) - ramp(8.1)  # it returns, so that the FFT's period does not show
    tube = Tube(length_m=40.0, cells=320, modes=8)
    part = slice(0, 3000)
    found = simulate_tube(tube, make_pressure(100 * inlet[part])).channel("P2").values / 100
    assert float(np.sqrt(np.mean((found - build_linear(tube, inlet)[part]) ** 2))) < 6e-4


def test_what_flows_in_is_in_the_volume_at_the_end() -> None:
    tube = Tube(length_m=5.0)
    values = np.full(4000, 3e5)
    values[:10] = 1e5
    found = simulate_tube(tube, make_pressure(values))
    assert found.channel("P2").values[5] == pytest.approx(1e5)
    assert found.channel("P2").values[-1] == pytest.approx(3e5, rel=1e-3)


def test_a_tube_of_half_the_cells_gives_nearly_the_same() -> None:
    coarse, fine = (
        simulate_tube_record(Tube(length_m=10.0, cells=cells), 1, 600, 0.01).channel("P2").values
        for cells in (40, 80)
    )
    assert float(np.sqrt(np.mean((coarse - fine) ** 2))) < 500.0


def test_a_longer_tube_answers_later() -> None:
    values = np.full(2500, 2e5)
    values[:10] = 1e5
    ends = [
        simulate_tube(Tube(length_m=length), make_pressure(values)).channel("P2").values
        for length in (10.0, 20.0, 40.0)
    ]
    late = [PERIOD * (np.argmax(end > 1.02e5) - 10) for end in ends]
    for length, time in zip((10.0, 20.0, 40.0), late, strict=True):
        assert 0.9 * length / 343 < time < 1.5 * length / 290
    assert late[0] < late[1] < late[2]


def test_both_patterns_are_those_of_the_specification_and_stretch_above_40_m() -> None:
    times = np.arange(0.0, 30.0, 0.01)
    holds = build_excitation(1, 40.0, times)
    assert list(dict.fromkeys(holds)) == pytest.approx(
        [1e5, 3e5, 4.8e5, 2e5, 4e5, 0.5e5, 3.5e5, 2.5e5, 4.5e5, 1.5e5]
    )
    mixed = build_excitation(2, 40.0, times)
    assert (mixed[0], mixed[60], mixed[420]) == (2.5e5, 4e5, 1e5)
    chirp = mixed[times >= 18.0]
    assert np.count_nonzero(np.diff(np.sign(chirp - 2.5e5)) != 0) == pytest.approx(6.5, abs=1.5)
    np.testing.assert_allclose(build_excitation(2, 80.0, 2 * times), mixed)
    with pytest.raises(InvalidSettings, match="need 1 or 2"):
        build_excitation(3, 40.0, times)


def test_gauges_tell_whole_digits_with_noise() -> None:
    record = simulate_tube_record(Tube(length_m=5.0), 1, 300, 0.01)
    told, again = (add_gauge_errors(record, 7) for _ in range(2))
    values = told.channel("P2").values
    np.testing.assert_array_equal(values, again.channel("P2").values)
    digits = values / (1e6 / 4096)
    np.testing.assert_allclose(digits, np.round(digits), atol=1e-9)
    assert np.std(values - record.channel("P2").values) == pytest.approx(505.0, rel=0.15)


@pytest.mark.parametrize(
    ("changes", "pointer"),
    [
        ({"length_m": 0.1}, "/parameters/length_m"),
        ({"bore_m": float("nan")}, "/parameters/bore_m"),
        ({"cells": 9000}, "/parameters/cells"),
        ({"cells": 7}, "/parameters/cells"),
        ({"volume_m3": -1.0}, "/parameters/volume_m3"),
    ],
)
def test_a_tube_that_cannot_be_is_told(changes: dict[str, Any], pointer: str) -> None:
    with pytest.raises(InvalidSettings) as caught:
        Tube(**changes)
    assert caught.value.pointer == pointer


def test_inlets_that_cannot_be_and_simulations_that_take_too_long_are_told() -> None:
    tube = Tube(length_m=20.0)
    with pytest.raises(InvalidRecord, match="falls to"):
        simulate_tube(tube, make_pressure(np.array([0.0, -2e5, 0.0])))
    with pytest.raises(InvalidRecord, match="two samples or more"):
        simulate_tube(tube, make_pressure(np.array([0.0])))
    with pytest.raises(InvalidSettings, match="Request fewer samples"):
        simulate_tube(Tube(cells=5000), make_pressure(np.zeros(10_000)))


def test_a_record_s_memory_is_bounded_and_no_period_is_too_long_to_be_told() -> None:
    with pytest.raises(InvalidSettings, match="need at most 500000 at a sample_time"):
        simulate_tube_record(Tube(length_m=5.0, cells=1), 1, 10_000_000, 0.005)
    with pytest.raises(InvalidSettings, match="Request fewer samples"):
        simulate_tube_record(Tube(length_m=5.0), 1, 2, 1e308)
