"""The pneumatic vane actuator with stick-slip friction (Eq. 23-25), exact between its events.

While it sticks and while it slides one way the actuator is linear, so each stretch is advanced by
a matrix exponential; the instants of breaking away, of stopping and of reaching an end stop are
found by bisection. Nothing is shared with the catalogue's model, which steps through them.
"""

from dataclasses import dataclass
from math import copysign, isfinite, pi

import numpy as np
from scipy.linalg import expm

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording

MAX_SAMPLES = 200_000
"""Samples of one simulation at most: about ten seconds of work."""

MAX_WORK = 300_000
"""Advances of the state in one simulation at most: about half a minute of one core."""

_MAX_PIECE = 1e-3  # s between looks for an event
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
        1/s.
    k_c : float
        Pa/rad.
    A_m : float
        Volume swept per radian, m³/rad (our choice; the paper gives none).
    B : float
        Viscous friction, N·m·s/rad (our choice).
    theta_s : float
        End stop on either side, rad.
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
    """Angle and chamber pressure from the supply pressure, at its samples; at rest before.

    Parameters
    ----------
    actuator : Actuator
    supply : Channel
        Pressure difference P_a in Pa, held or on lines between its samples by its `hold`.

    Returns
    -------
    Recording
        Channels ``P_a`` [Pa], ``theta`` [rad] and ``P`` [Pa].

    Raises
    ------
    InvalidRecord
        If a sample is missing, times repeat, or there are more than `MAX_SAMPLES`.
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
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is told
        found = _simulate_samples(_ActuatorState(actuator), supply)
    return Recording(
        (
            Channel("P_a", times, values, "Pa", supply.hold),
            Channel("theta", times, found[:, 0].copy(), "rad"),
            Channel("P", times, found[:, 1].copy(), "Pa"),
        )
    )


def _check_duration(duration: float) -> None:
    """Refuse a record (s) whose pieces alone are more work than may be done."""
    if not duration / _MAX_PIECE <= MAX_WORK:
        raise InvalidSettings(
            "/sample_time",
            f"the record lasts {duration:g} s; the actuator can be simulated for "
            f"at most {MAX_WORK * _MAX_PIECE:g} s. Request fewer samples or a smaller sample_time.",
        )


def _simulate_samples(plant: "_ActuatorState", supply: Channel) -> FloatArray:
    """Angle and pressure, (samples, 2)."""
    times, values = supply.times, supply.values
    found = np.zeros((times.size, 2))
    for k in range(times.size - 1):
        step = float(times[k + 1] - times[k])
        slope = 0.0 if supply.hold == "zero" else float(values[k + 1] - values[k]) / step
        plant.advance(float(values[k]), slope, step)
        if not np.all(np.isfinite(plant.state)):
            raise InvalidSettings(
                "/parameters",
                f"with these values the actuator's state is not finite at t = {times[k + 1]:g} s; "
                "choose values nearer to the defaults, or a smaller supply pressure",
            )
        found[k + 1] = plant.state[_THETA], plant.state[_P]
    return found


class _ActuatorState:
    """State and mode of the actuator: the way it slides (1, -1), or 0 while it sticks."""

    def __init__(self, actuator: Actuator) -> None:
        self._a = actuator
        self.state = np.zeros(6)
        self.state[_ONE] = 1.0
        self._way = 0
        self._systems = {way: self._build_system(way) for way in (-1, 0, 1)}
        self._known: dict[tuple[int, float], FloatArray] = {}
        self._work = 0

    def advance(self, supply: float, slope: float, time: float) -> None:
        """Go on for a time (s) in which the supply begins with a value (Pa) and slope (Pa/s)."""
        self.state[_SUPPLY], self.state[_SLOPE] = supply, slope
        pieces = max(1, round(time / _MAX_PIECE))
        for _ in range(pieces):
            left = time / pieces
            self._start_sliding()
            while left > 0:
                left -= self._advance_until_event(left)

    def _advance_until_event(self, time: float) -> float:
        """Go on until something changes, at most for a time; gives the time that passed."""
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
        """Whether the present mode has ended in a state that it would lead to."""
        if self._way == 0:
            return self._find_slide_direction(state) != 0
        return bool(state[_OMEGA] * self._way < 0 or state[_THETA] * self._way > self._a.theta_s)

    def _find_slide_direction(self, state: FloatArray) -> int:
        """The way in which an arm at rest begins to slide; 0 if it stays."""
        torque = self._a.A_m * state[_P]
        way = int(copysign(1, torque))
        if abs(torque) <= self._a.F_max or state[_THETA] * way >= self._a.theta_s:
            return 0
        return way

    def _change_mode(self) -> None:
        """At an event: come to rest, or begin to slide."""
        if self._way != 0:
            limit = self._a.theta_s
            self.state[_THETA] = min(max(self.state[_THETA], -limit), limit)
            self.state[_OMEGA] = 0.0
        self._way = self._find_slide_direction(self.state)

    def _start_sliding(self) -> None:
        if self._way == 0:
            self._way = self._find_slide_direction(self.state)

    def _predict_state(self, time: float, keep: bool = False) -> FloatArray:
        """The state after a time in the present mode."""
        self._work += 1
        if self._work > MAX_WORK:
            raise InvalidSettings(
                "/samples",
                f"the arm stops and breaks away so often that the simulation takes more than "
                f"{MAX_WORK} steps. Request fewer samples, or choose parameters nearer to the defaults.",
            )
        key = (self._way, time)
        matrix = self._known.get(key)
        if matrix is None:
            matrix = expm(self._systems[self._way] * time)
            if keep and len(self._known) < 64:
                self._known[key] = matrix
        found: FloatArray = matrix @ self.state
        return found

    def _build_system(self, way: int) -> FloatArray:
        """Matrix of d/dt (theta, omega, P, supply, its slope, 1) in a mode."""
        a = self._a
        system = np.zeros((6, 6))
        system[_P, [_P, _SUPPLY]] = -a.k_a, a.k_b
        system[_SUPPLY, _SLOPE] = 1.0
        if way != 0:
            system[_THETA, _OMEGA] = 1.0
            system[_OMEGA, [_OMEGA, _P, _ONE]] = -a.B / a.J, a.A_m / a.J, -a.F_c * way / a.J
            system[_P, _OMEGA] = -a.k_c
        return system
