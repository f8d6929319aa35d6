"""Long pneumatic tube with a volume at its end: 1-D gas dynamics with heat exchange.

Staggered leapfrog: pressures and densities at nodes, mass flows on the faces between them. Wall
friction is laminar (Hagen-Poiseuille) or turbulent (Blasius), and the gas exchanges heat with
walls of constant temperature. Optional modes of the boundary layer make the laminar friction
exact at all frequencies, for comparison with the linear solution.

Source: textbook equations (mass, momentum, energy; Blasius; Dittus-Boelter). The tube is that of
Asakura and Guo, section 5.2: bore 8 mm, 40 m.
"""

from dataclasses import dataclass, replace
from math import ceil, isfinite, pi, sqrt

import numpy as np
from scipy.special import jn_zeros

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.jit import jit_compile
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Recording

ATMOSPHERE = 100_000.0
"""Atmospheric pressure in Pa; pressures of records are relative to it."""

GAS_CONSTANT = 287.05  # J/kg/K, dry air
HEAT_CAPACITY_RATIO = 1.4
VISCOSITY = 1.82e-5  # Pa·s
PRANDTL = 0.71

MAX_WORK = 2e8
"""Most cells times steps of one simulation: about half a minute of one core."""

MAX_SAMPLES = 5_000_000
"""Most samples of the command that a record's regulator follows: about 400 MB."""

_MAX_CELL_LENGTH = 5.0  # m; longer cells do not carry the waves of the patterns

_LAMINAR_REYNOLDS, _TURBULENT_REYNOLDS = 2000.0, 4000.0
_COURANT = 0.8 / 1.15
_VOLUME_HEAT_TRANSFER = 20.0  # W/m²/K
_PILOT_TIME_CONSTANT = 0.05  # s
_VALVE_CONDUCTANCE, _MAX_INFLOW, _MAX_OUTFLOW = 4e-7, 0.025, 0.020  # kg/s/Pa, kg/s
_VALVE_VOLUME = 30e-6  # m³


@dataclass(frozen=True, slots=True)
class Tube:
    """A tube and the volume at its end.

    Attributes
    ----------
    length_m, bore_m : float
        Length and bore, m.
    volume_m3 : float
        Volume at the end, m³.
    temperature : float
        Temperature of the walls and of the inflowing gas, K.
    cells : int
        Number of cells. 0: cells of 0.5 m, or of 0.25 m if the tube is shorter than 20 m.
    modes : int
        Boundary-layer modes of laminar friction and heat exchange; 0: steady-flow values.
    """

    length_m: float = 40.0
    bore_m: float = 0.008
    volume_m3: float = 0.5e-3
    temperature: float = 293.0
    cells: int = 0
    modes: int = 0

    def __post_init__(self) -> None:
        ranges = {
            "length_m": (0.5, 2000.0),
            "bore_m": (5e-4, 0.1),
            "volume_m3": (0.0, 1.0),
            "temperature": (150.0, 600.0),
            "cells": (0, 5000),
            "modes": (0, 50),
        }
        for name, (least, most) in ranges.items():
            value = getattr(self, name)
            if not (isfinite(value) and least <= value <= most):
                raise InvalidSettings(
                    f"/parameters/{name}", f"found {value:g}; need from {least:g} to {most:g}"
                )
        if self.cells and self.length_m > _MAX_CELL_LENGTH * self.cells:
            raise InvalidSettings(
                "/parameters/cells",
                f"found {self.cells}, each {self.length_m / self.cells:g} m long; need "
                f"{ceil(self.length_m / _MAX_CELL_LENGTH)} or more for {self.length_m:g} m, or 0 "
                "for the default number",
            )

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return self.cells or ceil(self.length_m / (0.5 if self.length_m >= 20 else 0.25) - 1e-9)

    @property
    def max_step(self) -> float:
        """Longest step of the scheme in s."""
        speed = sqrt(HEAT_CAPACITY_RATIO * GAS_CONSTANT * self.temperature)
        return _COURANT * self.length_m / self.n_cells / speed


def simulate_tube(tube: Tube, inlet: Channel, *, regulator: bool = False) -> Recording:
    """Simulate the pressures at both ends of a tube at its inlet's samples, from rest.

    Parameters
    ----------
    tube : Tube
    inlet : Channel
        Pressure above atmosphere in Pa at regular times. It is the inlet pressure, linear between
        samples. With `regulator` it is the held command of a pressure regulator at the inlet.
    regulator : bool
        Pilot time constant of 50 ms, and a saturating valve that fills 30 mL at the inlet.

    Returns
    -------
    Recording
        ``P1`` at the inlet and ``P2`` in the volume, in Pa above atmosphere.

    Raises
    ------
    InvalidRecord
        If the inlet is not regular, falls to vacuum, or the flow would become supersonic.
    InvalidSettings
        If the simulation would take too long.
    """
    times, values = inlet.times, inlet.values
    period = _check_inlet_period(inlet)
    substeps = _count_substeps(tube, times.size, period)
    dx = tube.length_m / tube.n_cells
    geometry = np.array([dx, tube.bore_m, tube.volume_m3, tube.temperature, period / substeps])
    zeros = np.zeros((2, tube.modes))  # j² of the friction and of the heat exchange
    if tube.modes:
        zeros[0], zeros[1] = jn_zeros(2, tube.modes) ** 2, jn_zeros(0, tube.modes) ** 2
    pressures = _simulate_flow(
        geometry, zeros, values + ATMOSPHERE, substeps, tube.n_cells, regulator
    )
    if not np.all(np.isfinite(pressures)):
        raise InvalidRecord(
            "the flow in the tube becomes too fast for this scheme; give smaller or slower "
            "pressure changes"
        )
    ends = pressures - ATMOSPHERE
    return Recording(
        (
            Channel("P1", times, ends[:, 0].copy(), "Pa"),
            Channel("P2", times, ends[:, 1].copy(), "Pa"),
        )
    )


def _count_substeps(tube: Tube, samples: int, period: float) -> int:
    """Count the steps in a period; raise if the simulation takes too many."""
    substeps = period / tube.max_step  # not finite for the longest periods
    work = float(samples) * max(substeps, 1.0) * tube.n_cells * (1 + tube.modes / 4)
    if not work <= MAX_WORK:
        raise InvalidSettings(
            "/samples",
            f"{samples} samples of {tube.n_cells} cells take {work:.2g} cell steps; at "
            f"most {MAX_WORK:.2g} are allowed. Request fewer samples or cells.",
        )
    return ceil(substeps)


def _check_inlet_period(inlet: Channel) -> float:
    times, values = inlet.times, inlet.values
    if times.size < 2 or not inlet.sampling.is_regular:
        raise InvalidRecord("the inlet pressure needs two samples or more at regular times")
    lowest = float(np.min(values)) if np.all(np.isfinite(values)) else -np.inf
    if not lowest > -0.9 * ATMOSPHERE:
        raise InvalidRecord(
            f"the inlet pressure falls to {lowest:g} Pa above atmosphere; need more than "
            f"{-0.9 * ATMOSPHERE:g} Pa at every sample"
        )
    return float(times[-1] - times[0]) / (times.size - 1)


@jit_compile
def _simulate_flow(
    geometry: FloatArray,
    zeros: FloatArray,
    command: FloatArray,
    substeps: int,
    n: int,
    regulator: bool,
) -> FloatArray:
    """Simulate the pressures (samples, 2) in Pa at both ends."""
    bore, wall, dt = geometry[1], geometry[3], geometry[4]
    gas = np.empty((3, n + 1))  # pressure, density, temperature at the nodes
    gas[0], gas[2] = command[0], wall
    gas[1] = command[0] / (GAS_CONSTANT * wall)
    flow, lagged = np.zeros(n), np.zeros((zeros.shape[1], n))
    warmed = np.full((zeros.shape[1], n + 1), command[0])
    pressures = np.empty((command.size, 2))
    pressures[0, :] = command[0]
    pilot = command[0]
    inlet_volume = _VALVE_VOLUME + geometry[0] * pi * bore**2 / 8  # with half a cell of the tube
    for k in range(command.size - 1):
        for j in range(substeps):
            if regulator:
                pilot += dt / _PILOT_TIME_CONSTANT * (command[k] - pilot)
                inflow = min(
                    max(_VALVE_CONDUCTANCE * (pilot - gas[0, 0]), -_MAX_OUTFLOW), _MAX_INFLOW
                )
                gas[0, 0] += dt * GAS_CONSTANT * wall / inlet_volume * (inflow - flow[0])
            else:
                part = (j + 0.5) / substeps
                gas[0, 0] = command[k] + part * (command[k + 1] - command[k])
            gas[1, 0] = gas[0, 0] / (GAS_CONSTANT * wall)
            _step_momentum(geometry, zeros[0], gas, flow, lagged)
            _step_balances(geometry, zeros[1], gas, flow, warmed)
        pressures[k + 1, 0] = gas[0, 0] if regulator else command[k + 1]
        pressures[k + 1, 1] = gas[0, n]
    return pressures


@jit_compile
def _step_momentum(
    geometry: FloatArray, zeros: FloatArray, gas: FloatArray, flow: FloatArray, lagged: FloatArray
) -> None:
    """Step the mass flows; friction is implicit, convection is from the donor cell."""
    dx, bore, dt = geometry[0], geometry[1], geometry[4]
    area, n = pi * bore**2 / 4, flow.size
    inertia = 1.0  # includes the omitted modes: the sum of 4/j² over all modes is 1/3
    if zeros.size:
        inertia += 1 / 3 - np.sum(4 / zeros)
    before = flow[0] ** 2 / (0.5 * (gas[1, 0] + gas[1, 1]) * area)
    carried = before  # momentum flux through the node on the left
    for i in range(n):
        density = 0.5 * (gas[1, i] + gas[1, i + 1])
        following = before
        if i + 1 < n:
            following = flow[i + 1] ** 2 / (0.5 * (gas[1, i + 1] + gas[1, i + 2]) * area)
        passes = before
        if i + 1 < n and flow[i] + flow[i + 1] < 0:
            passes = following
        elif i + 1 == n and flow[i] < 0:
            passes = 0.0  # gas that leaves the volume was at rest
        force = -area * (gas[0, i + 1] - gas[0, i]) / dx - (passes - carried) / dx
        friction = _compute_friction(abs(flow[i]) * bore / (area * VISCOSITY)) / (density * bore**2)
        rate = VISCOSITY / density / (bore / 2) ** 2
        for mode in range(zeros.size):
            force -= 4 * rate * (flow[i] - lagged[mode, i])
        flow[i] = (inertia * flow[i] + dt * force) / (inertia + dt * friction)
        for mode in range(zeros.size):
            share = dt * rate * zeros[mode]
            lagged[mode, i] = (lagged[mode, i] + share * flow[i]) / (1 + share)
        before, carried = following, passes


@jit_compile
def _compute_friction(reynolds: float) -> float:
    """Compute friction times density and bore², Pa·s: laminar, then Blasius."""
    return _blend_regimes(reynolds, 32 * VISCOSITY, 0.1582 * reynolds**0.75 * VISCOSITY)


@jit_compile
def _compute_nusselt(reynolds: float) -> float:
    """Compute the Nusselt number: laminar, then Dittus-Boelter."""
    return _blend_regimes(reynolds, 8.0, 0.023 * reynolds**0.8 * PRANDTL**0.4)


@jit_compile
def _blend_regimes(reynolds: float, laminar: float, turbulent: float) -> float:
    """Interpolate linearly between the laminar and the turbulent value."""
    part = (reynolds - _LAMINAR_REYNOLDS) / (_TURBULENT_REYNOLDS - _LAMINAR_REYNOLDS)
    return laminar + min(max(part, 0.0), 1.0) * (turbulent - laminar)


@jit_compile
def _step_balances(
    geometry: FloatArray, zeros: FloatArray, gas: FloatArray, flow: FloatArray, warmed: FloatArray
) -> None:
    """Step mass and energy of every cell, and the heat exchange with its walls."""
    dx, bore, volume, wall, dt = geometry
    area, n = pi * bore**2 / 4, flow.size
    conductivity = (
        VISCOSITY * HEAT_CAPACITY_RATIO * GAS_CONSTANT / (HEAT_CAPACITY_RATIO - 1) / PRANDTL
    )
    entering = flow[0] * (gas[2, 0] if flow[0] >= 0 else gas[2, 1])
    for i in range(1, n + 1):
        is_last = i == n
        leaving = 0.0 if is_last else flow[i]
        donated = 0.0
        if not is_last:
            donated = flow[i] * (gas[2, i] if flow[i] >= 0 else gas[2, i + 1])
        length = 0.5 * dx if is_last else dx
        cell = area * length + (volume if is_last else 0.0)
        gas[1, i] += dt / cell * (flow[i - 1] - leaving)
        gain = dt * HEAT_CAPACITY_RATIO * GAS_CONSTANT / cell * (entering - donated)
        reynolds = 0.5 * (abs(flow[i - 1]) + abs(leaving)) * bore / (area * VISCOSITY)
        passed = _compute_nusselt(reynolds) * conductivity * pi * length  # W/K
        if zeros.size:
            passed = 0.0
            gain = _apply_boundary_layer(
                zeros, gas, i, dt, bore, gain, warmed, area * length / cell
            )
        if is_last:
            passed += _VOLUME_HEAT_TRANSFER * 4.84 * volume ** (2 / 3)
        share = dt * passed / (gas[1, i] * cell * GAS_CONSTANT / (HEAT_CAPACITY_RATIO - 1))
        temperature = ((gas[0, i] + gain) / (gas[1, i] * GAS_CONSTANT) + share * wall) / (1 + share)
        gas[2, i] = temperature
        gas[0, i] = gas[1, i] * GAS_CONSTANT * temperature
        entering = donated


@jit_compile
def _apply_boundary_layer(
    zeros: FloatArray,
    gas: FloatArray,
    i: int,
    dt: float,
    bore: float,
    gain: float,
    warmed: FloatArray,
    part: float,
) -> float:
    """Reduce a pressure gain by the heat of a laminar boundary layer; `part` of the cell is tube.

    With ζ² = Pr·s·r²/ν, 2 I₁(ζ)/(ζ I₀(ζ)) is the sum of 4/(ζ² + j²) over the zeros j of J₀.
    """
    rate = VISCOSITY / gas[1, i] / PRANDTL / (bore / 2) ** 2
    slow, rest = 0.0, 1.0
    for mode in range(zeros.size):
        weight = 4 / zeros[mode]
        share = dt * rate * zeros[mode]
        change = share / (1 + share) * (gas[0, i] + gain - warmed[mode, i])
        warmed[mode, i] += change
        slow += weight * change
        rest -= weight
    return (gain - (HEAT_CAPACITY_RATIO - 1) * part * slow) / (
        1 + (HEAT_CAPACITY_RATIO - 1) * part * rest
    )


def build_excitation(pattern: int, length_m: float, times: FloatArray) -> FloatArray:
    """Build the regulator's command (Pa above atmosphere) of one of the paper's patterns.

    Pattern 1 is ten holds of 3 s. Pattern 2 is 0.25 ± 0.15 MPa: a pseudo-random binary sequence
    with a clock of 0.6 s, and from 18 s a chirp from 0.05 to 0.8 Hz over 12 s. Above 40 m time is
    stretched by length/40.

    Raises
    ------
    InvalidSettings
        If there is no such pattern.
    """
    clock = times / max(1.0, length_m / 40.0)
    if pattern == 1:
        levels = np.array([0.10, 0.30, 0.48, 0.20, 0.40, 0.05, 0.35, 0.25, 0.45, 0.15])
        return np.asarray(1e6 * levels[np.clip((clock / 3).astype(np.int64), 0, 9)])
    if pattern != 2:
        raise InvalidSettings("/parameters/pattern", f"found {pattern}; need 1 or 2")
    bits = _generate_binary_sequence(32)
    indices = np.floor((clock - 0.5) / 0.6).astype(np.int64)
    binary = np.where(indices < 0, 0.0, bits[np.clip(indices, 0, bits.size - 1)])
    late = np.clip(clock - 18.0, 0.0, 12.0) / 12.0
    chirp = np.sin(2 * pi * 0.05 * 12.0 / np.log(16.0) * (16.0**late - 1.0))
    return np.asarray(1e6 * (0.25 + 0.15 * np.where(clock < 18.0, binary, chirp)))


def simulate_tube_record(tube: Tube, pattern: int, samples: int, period: float) -> Recording:
    """Simulate a tube whose regulator follows one of the paper's patterns.

    Parameters
    ----------
    tube : Tube
    pattern : int
        See `build_excitation`.
    samples : int
    period : float
        Sampling period, s. The command has a tenth of it, but at least 0.5 ms.

    Raises
    ------
    InvalidSettings, InvalidRecord
        As `simulate_tube` and `build_excitation`.
    """
    refinement = max(1, round(min(10.0, period / 5e-4)))
    if samples * refinement > MAX_SAMPLES:
        raise InvalidSettings(
            "/samples",
            f"found {samples}, whose command has {refinement} times as many; need at most "
            f"{MAX_SAMPLES // refinement} at a sample_time of {period:g} s",
        )
    _count_substeps(tube, samples * refinement, period / refinement)
    times = np.arange((samples - 1) * refinement + 1, dtype=np.float64) * (period / refinement)
    command = Channel("P1", times, build_excitation(pattern, tube.length_m, times), "Pa")
    whole = simulate_tube(tube, command, regulator=True)
    return Recording(
        tuple(
            replace(
                channel,
                times=channel.times[::refinement].copy(),
                values=channel.values[::refinement].copy(),
            )
            for channel in whole.channels
        )
    )


def _generate_binary_sequence(count: int) -> FloatArray:
    """Generate bits ±1 of x⁷ + x⁶ + 1 from the second last stage of a register of ones."""
    register = [1] * 7
    bits = []
    for _ in range(count):
        bits.append(1.0 if register[5] else -1.0)
        register = [register[6] ^ register[5], *register[:6]]
    return np.array(bits)


def add_gauge_errors(recording: Recording, seed: int) -> Recording:
    """Add the errors of gauges: range 1 MPa, 12 bit, noise of 0.5 kPa."""
    draws = np.random.Generator(np.random.Philox(seed))
    digit = 1e6 / 4096
    channels = []
    for channel in recording.channels:
        noisy = channel.values + 500.0 * draws.standard_normal(channel.values.size)
        quantised = digit * np.round(np.clip(noisy, 0.0, 1e6) / digit)
        channels.append(Channel(channel.name, channel.times, quantised, channel.unit, channel.hold))
    return Recording(tuple(channels))
