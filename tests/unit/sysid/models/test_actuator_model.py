"""The catalogue's actuator: its step against a plain twin, and its parameters found again."""

from math import copysign, pi

import numpy as np
import pytest

from service.plants.actuator import Actuator, simulate_actuator
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record
from sysid.identification.identify import identify
from sysid.models.catalogue.load import copy_catalogue_document, load_model
from sysid.models.parse import parse_model
from sysid.simulation.simulate import simulate
from tests.support.library.catalogue_cases import ARM

PUBLISHED = ARM | {"theta_s": 0.75 * pi}
KNOWN_SPREAD = {"J": 3e-3, "F_c": 1.5e-3, "F_max": 1.5e-3, "k_a": 5e-3, "k_c": 6e-3}
TIMES = 0.01 * np.arange(800)


def make_pressure(amplitude: float, seed: int = 1) -> Channel:
    """Waves and a random binary signal: the arm breaks away some twenty times in 8 s."""
    rng = np.random.default_rng(seed)
    waves = sum(
        level * np.sin(2 * pi * frequency * TIMES + phase)
        for level, frequency, phase in ((0.55, 0.35, 0), (0.6, 0.9, 1), (0.5, 2.3, 2))
    )
    binary = np.where(rng.integers(0, 2, 80)[np.arange(800) // 10] > 0, 0.5, -0.5)
    return Channel("P_a", TIMES, amplitude * (waves + binary), "Pa")


def angle(given: Channel, substeps: int = 8, **values: float) -> FloatArray:
    model = parse_model({**copy_catalogue_document("actuator"), "solver": {"substeps": substeps}})
    known = PUBLISHED | {"theta(0)": 0.0} | values
    return simulate(model, [given], known, times=TIMES).channel("theta").values


class Twin:
    """Slide, rest, slide: each by the trapezoidal rule, solved as a linear system."""

    def __init__(self, values: dict[str, float]) -> None:
        self.v = values
        self.theta = self.omega = self.p = 0.0

    def slid(self, omega: float, p: float, supply: float, time: float, way: float) -> FloatArray:
        """Velocity and pressure after sliding one way."""
        v = self.v
        system = np.array([[-v["B"], v["A_m"]], [-v["k_c"], -v["k_a"]]])
        system[0] /= v["J"]
        drive = np.array([-v["F_c"] * way / v["J"], v["k_a"] * supply])
        now = np.array([omega, p])
        right = now + time * (system @ now / 2 + drive)
        return np.linalg.solve(np.eye(2) - time * system / 2, right)

    def step(self, supply: float, h: float) -> None:
        """One step of the recursion."""
        v, left, p, moved, omega = self.v, h, self.p, 0.0, 0.0
        if self.omega != 0:
            omega, p = self.slid(self.omega, self.p, supply, h, copysign(1, self.omega))
            left = 0.0 if omega * self.omega > 0 else h * (1 - self.omega / (self.omega - omega))
            p = self.p + (p - self.p) * (h - left) / h
            moved = h * (self.omega + omega) / 2 if left == 0 else (h - left) * self.omega / 2
        if left > 0:
            omega, p, more = self.from_rest(p, supply, left)
            moved += more
        self.theta = float(np.clip(self.theta + moved, -v["theta_s"], v["theta_s"]))
        self.omega = 0.0 if abs(self.theta) >= v["theta_s"] else omega
        self.p = p

    def from_rest(self, p: float, supply: float, left: float) -> tuple[float, float, float]:
        """Velocity, pressure and way after a time that begins at rest."""
        v, limit = self.v, self.v["F_max"] / self.v["A_m"]
        half = left * v["k_a"] / 2
        later = (p * (1 - half) + 2 * half * supply) / (1 + half)
        if max(abs(p), abs(later)) <= limit:
            return 0.0, later, 0.0
        begin = p if abs(p) > limit else copysign(limit, later)
        time = left if abs(p) > limit else left * (later - begin) / (later - p)
        way = copysign(1, begin)
        omega, after = self.slid(0.0, begin, supply, time, way)
        if self.theta * way >= v["theta_s"] or omega * way <= 0:
            return 0.0, later if self.theta * way >= v["theta_s"] else after, 0.0
        return omega, after, time * omega / 2


@pytest.mark.parametrize("amplitude", [8e3, 60e3])  # the second one reaches the end stops
def test_the_step_equals_its_twin(amplitude: float) -> None:
    given, twin, found = make_pressure(amplitude), Twin(PUBLISHED), [0.0]
    for k in range(3999):
        if k % 5 == 0 and k:
            found.append(twin.theta)
        twin.step(float(np.interp((k + 0.5) * 0.002, TIMES, given.values)), 0.002)
    expected = np.array(found)
    np.testing.assert_allclose(angle(given, 5)[: expected.size], expected, rtol=1e-7, atol=1e-9)
    assert (np.max(np.abs(expected)) >= PUBLISHED["theta_s"]) == (amplitude > 5e4)


def test_half_the_step_has_a_quarter_of_the_error() -> None:
    given = make_pressure(12e3)
    exact = angle(given, 256)
    coarse, fine = (float(np.std(angle(given, n) - exact)) for n in (2, 8))
    assert coarse < 5e-4
    assert fine < coarse / 8


def test_below_break_away_the_arm_stays_and_above_it_moves() -> None:
    ramp = Channel("P_a", TIMES, 1e3 * TIMES, "Pa")  # P follows 1/k_a behind
    moved = np.abs(angle(ramp)) > 0
    first = TIMES[np.argmax(moved)]
    expected = PUBLISHED["F_max"] / PUBLISHED["A_m"] / 1e3 + 1 / PUBLISHED["k_a"]
    assert abs(first - expected) <= 0.01
    assert np.all(moved[np.argmax(moved) :])


def test_both_exact_symmetries_leave_the_angle_unchanged() -> None:
    given = make_pressure(12e3)
    before = angle(given)
    forces = {name: 1.7 * PUBLISHED[name] for name in ("J", "B", "F_c", "F_max", "A_m")}
    np.testing.assert_allclose(angle(given, **forces), before, rtol=0, atol=1e-9)
    pressures = {
        "A_m": PUBLISHED["A_m"] / 1.7,
        "k_b": 1.7 * PUBLISHED["k_a"],
        "k_c": 1.7 * PUBLISHED["k_c"],
    }
    np.testing.assert_allclose(angle(given, **pressures), before, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_published_parameters_are_found_again_from_the_exact_plant() -> None:
    given = make_pressure(12e3)
    noise = 1e-3 * np.random.default_rng(5).standard_normal(800)
    exact = simulate_actuator(Actuator(), given).channel("theta").values
    measured = Channel("theta", TIMES, exact + noise, "rad")
    found = identify(load_model("actuator"), Record((given,), (measured,)), seed=1)
    assert found.rms == pytest.approx(1e-3, rel=0.1)
    for estimate in found.parameters:
        if estimate.name in KNOWN_SPREAD:
            true = PUBLISHED[estimate.name]
            assert estimate.stderr is not None
            assert estimate.stderr < 1.3 * KNOWN_SPREAD[estimate.name] * true
            assert abs(estimate.value - true) < 4 * estimate.stderr, estimate
