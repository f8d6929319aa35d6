"""The exact actuator obeys Eq. 23-25 between its events, and the catalogue model tends to it."""

from math import pi
from typing import Any

import numpy as np
import pytest

from service.plants import actuator
from service.plants.actuator import MAX_SAMPLES, Actuator, simulate_actuator
from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Hold
from sysid.models.catalogue.load import copy_catalogue_document
from sysid.models.parse import parse_model
from sysid.simulation.simulate import simulate

TIMES = 0.01 * np.arange(400)
ARM = Actuator()


def supply(amplitude: float, hold: Hold = "first") -> Channel:
    waves = np.sin(4.1 * TIMES) + 0.7 * np.sin(11.3 * TIMES + 1) + 0.4 * np.sin(23.0 * TIMES + 2)
    return Channel("P_a", TIMES, amplitude * waves, "Pa", hold)


def simulate_model(given: Channel, substeps: int) -> FloatArray:
    model = parse_model({**copy_catalogue_document("actuator"), "solver": {"substeps": substeps}})
    names = ("J", "F_c", "F_max", "k_a", "k_c", "A_m", "B", "theta_s")
    values = {name: getattr(ARM, name) for name in names}
    found = simulate(model, [given], {**values, "theta(0)": 0.0}, times=TIMES)
    return found.channel("theta").values


@pytest.mark.parametrize("amplitude", [9e3, 80e3])  # the second one reaches the end stops
@pytest.mark.parametrize("hold", ["first", "zero"])
def test_the_model_of_the_catalogue_tends_to_the_exact_plant(amplitude: float, hold: Any) -> None:
    given = supply(amplitude, hold)
    exact = simulate_actuator(ARM, given).channel("theta").values
    errors = [float(np.sqrt(np.mean((simulate_model(given, n) - exact) ** 2))) for n in (8, 128)]
    assert errors[0] < 2e-4
    assert errors[1] < 2e-5
    assert (np.max(np.abs(exact)) == ARM.theta_s) == (amplitude > 1e4)


def test_a_slow_ramp_breaks_the_arm_away_at_f_max() -> None:
    ramp = Channel("P_a", TIMES, 5e3 * TIMES, "Pa")
    found = simulate_actuator(ARM, ramp)
    moved = np.flatnonzero(found.channel("theta").values > 0)[0]
    pressure = found.channel("P").values
    limit = ARM.F_max / ARM.A_m
    assert pressure[moved - 1] <= limit
    assert pressure[moved - 1] + 0.01 * 5e3 >= limit
    assert np.all(found.channel("theta").values[:moved] == 0)


def test_at_a_constant_pressure_it_slides_at_the_speed_of_the_balance() -> None:
    free = Actuator(theta_s=1e6)
    found = simulate_actuator(free, Channel("P_a", TIMES, np.full(400, 20e3), "Pa"))
    speed = np.diff(found.channel("theta").values)[-1] / 0.01
    # A_m P = B omega + F_c and k_a P = k_b P_a - k_c omega
    expected = (free.k_b * 20e3 - free.k_a * free.F_c / free.A_m) / (
        free.k_c + free.k_a * free.B / free.A_m
    )
    assert speed == pytest.approx(expected, rel=1e-9)


def test_turning_all_pressures_round_turns_the_arm_round() -> None:
    given = supply(12e3)
    turned = Channel("P_a", TIMES, -given.values, "Pa")
    first, second = (simulate_actuator(ARM, one).channel("theta").values for one in (given, turned))
    np.testing.assert_allclose(first, -second, rtol=0, atol=1e-12)


def test_what_cannot_be_simulated_is_told() -> None:
    with pytest.raises(InvalidSettings, match="below the Coulomb friction"):
        Actuator(F_max=0.01)
    with pytest.raises(InvalidSettings, match="/parameters/J"):
        Actuator(J=0.0)
    many = np.arange(float(MAX_SAMPLES + 1))
    for times, values in ((TIMES[:1], TIMES[:1]), (many, many), (0 * TIMES, TIMES)):
        with pytest.raises(InvalidRecord):
            simulate_actuator(ARM, Channel("P_a", times, values, "Pa"))


@pytest.mark.parametrize("last", [1e6, 1e300])
def test_the_work_of_a_record_grows_with_its_time_and_is_bounded(last: float) -> None:
    with pytest.raises(InvalidSettings, match="at most 300 s") as caught:
        simulate_actuator(ARM, Channel("P_a", np.array([0.0, last]), np.zeros(2), "Pa"))
    assert caught.value.pointer == "/sample_time"


def test_an_arm_that_stops_too_often_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(actuator, "MAX_WORK", 8_000)
    simulate_actuator(ARM, Channel("P_a", TIMES, np.zeros(400), "Pa"))  # at rest: no event
    with pytest.raises(InvalidSettings, match="so often"):
        simulate_actuator(ARM, Channel("P_a", TIMES, 12e3 * np.sin(40 * TIMES), "Pa"))


@pytest.mark.parametrize("changes", [{"k_a": 1e308}, {"J": 1e-308}, {"k_c": 1e200}, {"B": 1e308}])
def test_a_state_that_is_not_finite_is_told(changes: dict[str, float]) -> None:
    with pytest.raises(InvalidSettings, match="is not finite at t = ") as caught:
        simulate_actuator(Actuator(**changes), supply(12e3))
    assert caught.value.pointer == "/parameters"


def test_the_default_stop_is_half_of_270_degrees() -> None:
    assert pytest.approx(0.75 * pi) == ARM.theta_s
