"""Pneumatic vane actuator with stick-slip friction (Eq. 23-25), exact between its events.

While it sticks, and while it slides in one direction, the actuator is linear. So a matrix
exponential advances each stretch. The times of breaking away, stopping and reaching an end stop
are found by bisection. The catalogue's model integrates over these events; it shares no code.
"""

from dataclasses import dataclass
from math import copysign, isfinite, pi

import numpy as np
from scipy.linalg import expm

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording

MAX_SAMPLES = 200_000
"""Most samples of one simulation: about ten seconds of work."""

MAX_WORK = 300_000
"""Most advances of the state in one simulation: about half a minute of one core."""

_MAX_PIECE = 1e-3  # s, longest time between checks for an event
_HALVINGS = 50
_THETA, _OMEGA, _P, _SUPPLY, _SLOPE, _ONE = range(6)


@dataclass(frozen=True, slots=True)
class Actuator:
    """Parameters of the actuator, by default those of the paper's Table 4 with k_b = k_a.

    Attributes
    ----------
    J : float
        Moment of inertia, kg·m².
    F_c, F_max : float
        Coulomb friction and break-away torque, N·m.
    k_a, k_b : float
        Pressure dynamics, 1/s.
    k_c : float
        Pressure change per angle, Pa/rad.
    A_m : float
        Volume swept per radian, m³/rad (our choice; the paper gives none).
    B : float
        Viscous friction, N·m·s/rad (our choice).
    theta_s : float
        Angle of the end stops on both sides, rad.
    """

    J: float = 3.6e-4
    F_c: float = 1.2317e-2
    F_max: float = 3.3333e-2
    k_a: float = 83.089
    k_b: float = 83.089
    k_c: float = 456.99e3
    A_m: float = 5.0e-6
    B: float = 1.0e-3
    theta_s: float = 0.75 * pi

    def __post_init__(self) -> None:
        for name in ("J", "F_c", "F_max", "k_a", "k_b", "k_c", "A_m", "B", "theta_s"):
            value = getattr(self, name)
            if not isfinite(value) or value < 0 or (name in ("J", "A_m") and value == 0):
                raise InvalidSettings(f"/parameters/{name}", f"{value!r} is not a number above 0")
        if self.F_max < self.F_c:
            raise InvalidSettings(
                "/parameters/F_max",
                f"{self.F_max:g} N·m is below the Coulomb friction of {self.F_c:g} N·m; need at "
                "least as much",
            )


def simulate_actuator(actuator: Actuator, supply: Channel) -> Recording:
    """Simulate angle and chamber pressure at the supply pressure's samples, from rest.

    Parameters
    ----------
    actuator : Actuator
    supply : Channel
        Pressure difference P_a in Pa; its `hold` says if it is held or linear between samples.

    Returns
    -------
    Recording
        Channels ``P_a`` [Pa], ``theta`` [rad] and ``P`` [Pa].

    Raises
    ------
    InvalidRecord
        If a sample is missing, times repeat, or there are more samples than `MAX_SAMPLES`.
    InvalidSettings
        If the simulation would take more than `MAX_WORK`, or diverges.
    """
    times, values = supply.times, supply.values
    if not 2 <= times.size <= MAX_SAMPLES:
        raise InvalidRecord(f"found {times.size} samples; need from 2 to {MAX_SAMPLES}")
    if not np.all(np.isfinite(values)) or np.any(np.diff(times) <= 0):
        raise InvalidRecord(
            "the supply pressure needs a finite value at every time, and increasing times"
        )
    _check_duration(float(times[-1]) - float(times[0]))
    with np.errstate(over="ignore", invalid="ignore"):  # overflow is reported below
        simulated = _simulate_samples(_ActuatorState(actuator), supply)
    return Recording(
        (
            Channel("P_a", times, values, "Pa", supply.hold),
            Channel("theta", times, simulated[:, 0].copy(), "rad"),
            Channel("P", times, simulated[:, 1].copy(), "Pa"),
        )
    )


def _check_duration(duration: float) -> None:
    """Raise if the duration (s) alone takes more than `MAX_WORK` advances."""
    if not duration / _MAX_PIECE <= MAX_WORK:
        raise InvalidSettings(
            "/sample_time",
            f"the record lasts {duration:g} s; the actuator can be simulated for "
            f"at most {MAX_WORK * _MAX_PIECE:g} s. Request fewer samples or a smaller sample_time.",
        )


def _simulate_samples(plant: "_ActuatorState", supply: Channel) -> FloatArray:
    """Simulate angle and pressure; the result has shape (samples, 2)."""
    times, acting = supply.times, supply.acting
    last = np.searchsorted(acting.times, times + 1e-9 * np.ptp(times), side="right") - 1
    values, hold = acting.values[np.clip(last, 0, times.size - 1)], acting.effective_hold
    simulated = np.zeros((times.size, 2))
    for k in range(times.size - 1):
        step = float(times[k + 1] - times[k])
        slope = 0.0 if hold == "zero" else float(values[k + 1] - values[k]) / step
        plant.advance(float(values[k]), slope, step)
        if not np.all(np.isfinite(plant.state)):
            raise InvalidSettings(
                "/parameters",
                f"with these values the actuator's state is not finite at t = {times[k + 1]:g} s; "
                "choose values nearer to the defaults, or a smaller supply pressure",
            )
        simulated[k + 1] = plant.state[_THETA], plant.state[_P]
    return simulated


class _ActuatorState:
    """State and mode of the actuator; the mode is its direction (1, -1), or 0 if it sticks."""

    def __init__(self, actuator: Actuator) -> None:
        self._a = actuator
        self.state = np.zeros(6)
        self.state[_ONE] = 1.0
        self._direction = 0
        self._systems = {direction: self._build_system(direction) for direction in (-1, 0, 1)}
        self._exponentials: dict[tuple[int, float], FloatArray] = {}
        self._work = 0

    def advance(self, supply: float, slope: float, time: float) -> None:
        """Advance by a time (s); the supply starts at a value (Pa) with a slope (Pa/s)."""
        self.state[_SUPPLY], self.state[_SLOPE] = supply, slope
        pieces = max(1, round(time / _MAX_PIECE))
        for _ in range(pieces):
            remaining = time / pieces
            self._start_sliding()
            while remaining > 0:
                remaining -= self._advance_until_event(remaining)

    def _advance_until_event(self, time: float) -> float:
        """Advance to the next event, at most by a time (s); return the elapsed time."""
        after = self._predict_state(time, keep=True)
        if not self._has_mode_ended(after):
            self.state = after
            return time
        low, high = 0.0, time
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if self._has_mode_ended(self._predict_state(middle)):
                high = middle
            else:
                low = middle
        self.state = self._predict_state(high)
        self._change_mode()
        return high

    def _has_mode_ended(self, state: FloatArray) -> bool:
        """Whether the present mode has ended in a predicted state."""
        if self._direction == 0:
            return self._find_slide_direction(state) != 0
        return bool(
            state[_OMEGA] * self._direction < 0 or state[_THETA] * self._direction > self._a.theta_s
        )

    def _find_slide_direction(self, state: FloatArray) -> int:
        """Find the direction in which an arm at rest begins to slide; 0 if it stays."""
        torque = self._a.A_m * state[_P]
        direction = int(copysign(1, torque))
        if abs(torque) <= self._a.F_max or state[_THETA] * direction >= self._a.theta_s:
            return 0
        return direction

    def _change_mode(self) -> None:
        """Change the mode at an event: come to rest, or begin to slide."""
        if self._direction != 0:
            limit = self._a.theta_s
            self.state[_THETA] = min(max(self.state[_THETA], -limit), limit)
            self.state[_OMEGA] = 0.0
        self._direction = self._find_slide_direction(self.state)

    def _start_sliding(self) -> None:
        if self._direction == 0:
            self._direction = self._find_slide_direction(self.state)

    def _predict_state(self, time: float, keep: bool = False) -> FloatArray:
        """Predict the state after a time (s) in the present mode."""
        self._work += 1
        if self._work > MAX_WORK:
            raise InvalidSettings(
                "/samples",
                f"the arm stops and breaks away so often that the simulation takes more than "
                f"{MAX_WORK} steps. Request fewer samples, or choose parameters nearer to the "
                "defaults.",
            )
        key = (self._direction, time)
        matrix = self._exponentials.get(key)
        if matrix is None:
            matrix = expm(self._systems[self._direction] * time)
            if keep and len(self._exponentials) < 64:
                self._exponentials[key] = matrix
        predicted: FloatArray = matrix @ self.state
        return predicted

    def _build_system(self, direction: int) -> FloatArray:
        """Build the matrix of d/dt (theta, omega, P, supply, its slope, 1) in a mode."""
        a = self._a
        system = np.zeros((6, 6))
        system[_P, [_P, _SUPPLY]] = -a.k_a, a.k_b
        system[_SUPPLY, _SLOPE] = 1.0
        if direction != 0:
            system[_THETA, _OMEGA] = 1.0
            system[_OMEGA, [_OMEGA, _P, _ONE]] = -a.B / a.J, a.A_m / a.J, -a.F_c * direction / a.J
            system[_P, _OMEGA] = -a.k_c
        return system
