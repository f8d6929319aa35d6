"""Tuning rules for a linear model with a dead time: SIMC and AMIGO.

A rule needs the plant as k e^(-θs)/((T1 s + 1)(T2 s + 1)). Half of the first neglected time
constant is added to the last retained one, the rest to the dead time (Skogestad's half rule). An
integrating plant, k' e^(-θs)/(s (T2 s + 1)), is the limit of an infinite T1 with k/T1 = k'.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isfinite
from typing import Literal, get_args

import numpy as np

from sysid.control.controllers import MAX_NUMBER, Transport
from sysid.control.linear_form import IdentifiedModel, NotLinear
from sysid.control.transfer import (
    QuasiPolynomial,
    TransferFunction,
    compute_transfer_functions,
    group_by_delay,
)
from sysid.core.errors import InvalidSettings
from sysid.core.types import ComplexArray
from sysid.kernels.signals.past_reads import is_difference

TuningRule = Literal["simc", "amigo"]
ControllerKind = Literal["PI", "PID"]
RULES: tuple[TuningRule, ...] = get_args(TuningRule)
CONTROLLERS: tuple[ControllerKind, ...] = get_args(ControllerKind)

REFERENCES: Mapping[TuningRule, str] = {
    "simc": "S. Skogestad, Simple analytic rules for model reduction and PID controller tuning, "
    "J. Process Control 13 (2003) 291-309",
    "amigo": "K. J. Åström and T. Hägglund, Revisiting the Ziegler-Nichols step response method "
    "for PID control, J. Process Control 14 (2004) 635-650",
}
_CANCELLATION_TOLERANCE = 1e-6  # of a root: a zero so close to a pole cancels it
_INTEGRATOR_TOLERANCE = 1e-9  # of the fastest root: a pole there integrates
_REAL_POLE_TOLERANCE = 1e-3  # of a root: rounding separates a fourfold pole by less


@dataclass(frozen=True, slots=True)
class ProcessModel:
    """k e^(-θs)/((T1 s + 1)(T2 s + 1)), or k' e^(-θs)/(s (T2 s + 1)).

    Attributes
    ----------
    gain : float
        k; of an integrating process k', per s.
    delay : float
        θ in s.
    time_constant : float
        T1 in s; ``inf`` of an integrating process.
    second_time_constant : float
        T2 in s, 0 of a first-order one.
    """

    gain: float
    delay: float
    time_constant: float
    second_time_constant: float = 0.0

    @property
    def initial_slope(self) -> float:
        """k/T1, or k': the initial slope of the step response without T2."""
        return self.gain / self.time_constant if isfinite(self.time_constant) else self.gain


@dataclass(frozen=True, slots=True)
class Tuning:
    """Controller in the standard form by a rule, with the inputs of the rule.

    Attributes
    ----------
    gain, integral_time, derivative_time : float
        K in units of input per output, T_i and T_d in s.
    process : ProcessModel
        The model in the form of the rule.
    closed_loop_time_constant : float or None
        τ_c in s, of SIMC.
    formulas : tuple of str
    """

    rule: TuningRule
    controller: ControllerKind
    gain: float
    integral_time: float
    derivative_time: float
    process: ProcessModel
    closed_loop_time_constant: float | None
    formulas: tuple[str, ...]

    @property
    def reference(self) -> str:
        """Where the rule was published."""
        return REFERENCES[self.rule]


def tune_controller(
    identified: IdentifiedModel,
    input: str,
    output: str,
    *,
    rule: TuningRule = "simc",
    controller: ControllerKind = "PI",
    closed_loop_time_constant: float | None = None,
    transport: Transport | None = None,
) -> Tuning:
    """Tune a controller of one output by one input with a rule.

    Parameters
    ----------
    identified : IdentifiedModel
        A linear model in the differential form.
    rule : {"simc", "amigo"}
    controller : {"PI", "PID"}
    closed_loop_time_constant : float, optional
        τ_c of SIMC in s. Default: the effective dead time θ, as Skogestad recommends.
    transport : Transport, optional
        Transport between controller and plant; it is a part of the controlled system.

    Raises
    ------
    InvalidSettings
        If the rule has no answer for this model; the message says why.
    """
    if closed_loop_time_constant is not None and rule != "simc":
        raise InvalidSettings(
            "/tuning/closed_loop_time_constant", f"rule {rule!r} has no such setting; leave it out"
        )
    factors = factor_transfer_function(identified, input, output, transport)
    process = factors.reduce_order(2 if controller == "PID" and rule == "simc" else 1)
    try:
        tuning = (
            _tune_amigo(process, controller)
            if rule == "amigo"
            else _tune_simc(process, controller, closed_loop_time_constant)
        )
    except ZeroDivisionError:  # a product of small numbers underflows
        raise _make_refusal(_describe_impossible_gain(inf, process)) from None
    if not 0.0 < abs(tuning.gain) < MAX_NUMBER:
        raise _make_refusal(_describe_impossible_gain(tuning.gain, process))
    return tuning


def _describe_impossible_gain(gain: float, process: ProcessModel) -> str:
    return (
        f"the rule gives a gain of {gain:g}, which no controller can have. The process has a gain "
        f"of {process.gain:g} and a dead time of {process.delay:g} s."
    )


@dataclass(frozen=True, slots=True)
class TransferFactors:
    """Factors of gain · e^(-delay s) / Π (T s + 1), divided by s if it integrates."""

    gain: float
    delay: float
    time_constants: tuple[float, ...]
    is_integrating: bool

    def reduce_order(self, order: int) -> ProcessModel:
        """Reduce to first or second order by the half rule."""
        times = [inf, *self.time_constants] if self.is_integrating else list(self.time_constants)
        times += [0.0] * (order + 1 - len(times))
        leading, neglected = times[:order], times[order:]
        half = neglected[0] / 2
        last = leading[-1] + half
        delay = self.delay + half + sum(neglected[1:])
        if order == 1:
            return ProcessModel(self.gain, delay, last)
        return ProcessModel(self.gain, delay, leading[0], last)


def factor_transfer_function(
    identified: IdentifiedModel, input: str, output: str, transport: Transport | None
) -> TransferFactors:
    """Factor the transfer function from controller to output: gain, time constants, dead time.

    Raises
    ------
    InvalidSettings
        If it is not of that form.
    """
    if is_difference(identified.model):
        raise _make_refusal(
            "a tuning rule needs a model in the differential form, and this one is a recursion. "
            "Set the gain and the times by hand."
        )
    try:
        pairs = compute_transfer_functions(identified).pairs
    except NotLinear as error:
        raise _make_refusal(f"a tuning rule needs a linear model: {error}") from None
    [pair] = [
        candidate for candidate in pairs if (candidate.input, candidate.output) == (input, output)
    ]
    return _factor_pair(pair, transport or Transport())


def _factor_pair(pair: TransferFunction, transport: Transport) -> TransferFactors:
    if not pair.numerator or transport.gain == 0.0:
        raise _make_refusal(f"{pair.input!r} has no effect on {pair.output!r}")
    delay, above = _require_single_delay(
        pair.numerator, "the model has more than one dead time in a row"
    )
    _, below = _require_single_delay(
        pair.denominator, "the model has a dead time inside a loop of its own"
    )
    zeros, poles = _cancel_common_roots(_find_roots(above), _find_roots(below))
    if zeros.size:
        where = ", ".join(f"{zero:.4g}" for zero in np.sort_complex(zeros))
        raise _make_refusal(
            f"the model has a zero at s = {where}; the rules need a model without zeros"
        )
    scale = max((abs(pole) for pole in poles), default=0.0)
    integrators = [
        pole for pole in poles if abs(pole) <= _INTEGRATOR_TOLERANCE * scale or pole == 0
    ]
    others = [pole for pole in poles if abs(pole) > _INTEGRATOR_TOLERANCE * scale and pole != 0]
    if len(integrators) > 1:
        raise _make_refusal("the model integrates twice; the rules allow one integrator")
    if any(pole.real > 0 for pole in others):
        raise _make_refusal("the model is unstable by itself; the rules need a stable model")
    if any(abs(pole.imag) > _REAL_POLE_TOLERANCE * abs(pole) for pole in others):
        raise _make_refusal(
            "the model oscillates by itself (a pair of complex poles); the rules need real time "
            "constants"
        )
    times = [float(1.0 / abs(pole)) for pole in others]
    # Numerator and denominator at low frequencies, without s of the integrator.
    gain = float(above[0] / below[0] * np.prod(times)) * transport.gain
    if transport.time_constant > 0:
        times.append(transport.time_constant)
    if not times and not integrators:
        raise _make_refusal("the model has no time constant; the rules need at least one")
    ordered = tuple(sorted(times, reverse=True))
    return TransferFactors(gain, delay + transport.delay, ordered, bool(integrators))


def _require_single_delay(quasi: QuasiPolynomial, fault: str) -> tuple[float, list[float]]:
    parts = group_by_delay(quasi)
    if len(parts) > 1:
        raise _make_refusal(f"{fault}; the rules allow one between input and output")
    delay, powers = parts[0]
    return delay, powers


def _find_roots(powers: list[float]) -> ComplexArray:
    return np.asarray(np.roots(powers), dtype=np.complex128)


def _cancel_common_roots(
    zeros: ComplexArray, poles: ComplexArray
) -> tuple[ComplexArray, ComplexArray]:
    """Remove the roots that numerator and denominator share: those of states without effect."""
    remaining_poles, remaining_zeros = list(poles), []
    for zero in zeros:
        near = [
            i
            for i, pole in enumerate(remaining_poles)
            if abs(pole - zero) <= _CANCELLATION_TOLERANCE * abs(pole)
        ]
        if near:
            remaining_poles.pop(near[0])
        else:
            remaining_zeros.append(zero)
    return np.array(remaining_zeros, dtype=np.complex128), np.array(
        remaining_poles, dtype=np.complex128
    )


def _tune_simc(process: ProcessModel, controller: ControllerKind, wanted: float | None) -> Tuning:
    theta = process.delay
    if wanted is None and theta == 0.0:
        raise InvalidSettings(
            "/tuning/closed_loop_time_constant",
            "is missing; the model has no dead time to use instead, so give it in s",
        )
    tau = theta if wanted is None else wanted
    if not (isfinite(tau) and tau > 0):
        raise InvalidSettings(
            "/tuning/closed_loop_time_constant", f"{tau!r} is not a time above 0 s"
        )
    series_gain = 1.0 / (process.initial_slope * (tau + theta))
    series_time = min(process.time_constant, 4.0 * (tau + theta))
    derivative = process.second_time_constant
    # The rule is in the series form; convert it to the standard form.
    factor = 1.0 + derivative / series_time
    formulas = ["K' = T1/(k (τ_c + θ))", "T_i' = min(T1, 4 (τ_c + θ))"]
    if controller == "PID":
        formulas += ["T_d' = T2", "f = 1 + T_d'/T_i'", "K = K' f, T_i = T_i' f, T_d = T_d'/f"]
    else:
        formulas += ["K = K', T_i = T_i'"]
    return Tuning(
        "simc",
        controller,
        series_gain * factor,
        series_time * factor,
        derivative / factor,
        process,
        tau,
        tuple(formulas),
    )


def _tune_amigo(process: ProcessModel, controller: ControllerKind) -> Tuning:
    theta, t, rate = process.delay, process.time_constant, process.initial_slope
    if theta == 0.0:
        raise _make_refusal("AMIGO needs a dead time, and the model has none; use rule 'simc'")
    ratio = theta / t  # 0 of an integrating process
    if controller == "PI":
        part = 0.35 - ratio / (1.0 + ratio) ** 2
        gain = (0.15 * ratio + part) / (rate * theta)
        integral = 0.35 * theta + 13.0 * theta / (1.0 + 12.0 * ratio + 7.0 * ratio**2)
        derivative = 0.0
        formulas: tuple[str, ...] = (
            "K = 0.15/k + (0.35 - θ T1/(θ + T1)²) T1/(k θ)",
            "T_i = 0.35 θ + 13 θ T1²/(T1² + 12 θ T1 + 7 θ²)",
        )
    else:
        gain = (0.2 * ratio + 0.45) / (rate * theta)
        integral = (0.4 * ratio + 0.8) / (ratio + 0.1) * theta
        derivative = 0.5 * theta / (0.3 * ratio + 1.0)
        formulas = (
            "K = (0.2 + 0.45 T1/θ)/k",
            "T_i = (0.4 θ + 0.8 T1)/(θ + 0.1 T1) θ",
            "T_d = 0.5 θ T1/(0.3 θ + T1)",
        )
    return Tuning("amigo", controller, gain, integral, derivative, process, None, formulas)


def _make_refusal(detail: str) -> InvalidSettings:
    return InvalidSettings("/tuning", detail)
