"""Stability and margins of a loop around a linear model, with exact dead times."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import ceil, inf, pi

import numpy as np

from sysid.control.controllers import PidControl, Transport
from sysid.control.linear_form import IdentifiedModel, NotLinear
from sysid.control.transfer import (
    QuasiPolynomial,
    TransferFunction,
    compute_transfer_functions,
    group_by_delay,
)
from sysid.core.types import BoolArray, ComplexArray, FloatArray
from sysid.kernels.signals.past_reads import is_difference

_OUTER_DECADES = 3  # below the slowest and above the fastest part of the loop
_MAX_FREQUENCY_RATIO = 1e8  # of a corner frequency to the middle one; others are limited to it
_POINTS_PER_DECADE = 400  # frequencies
_MAX_TURN = 0.05  # rad that dead times turn from one frequency to the next
_LOUD_GAIN = 0.1  # loop gain below which they may turn farther: there are only gain margins there
_MAX_FREQUENCIES = 200_000
_NEGLIGIBLE_GAIN = 1e-3  # loop gain below which the search ends: a gain margin of a thousand
_SECANT_STEPS = 12  # enough for steps of a hundredth, also at sharp resonances
_PHASE_ROUNDING = 1e-6  # rad
_UNRESOLVED_TURN = 0.5  # rad: a larger turn from one frequency to the next may be missed
_MAX_REFINEMENTS = 8  # of such steps, one after the other
_REFINEMENT_PARTS = 10  # into which each of these steps is divided
_MAX_UNRESOLVED_STEPS = 1000  # more such steps come from a dead time at irrelevant frequencies


@dataclass(frozen=True, slots=True)
class Margins:
    """How far a loop is from instability (Åström and Hägglund, Advanced PID Control, section 4.6).

    If there are several crossings, each margin is that of the one nearest to instability.

    Attributes
    ----------
    is_stable : bool
        Whether no root of the characteristic equation has a real part above 0. The margins of an
        unstable loop are those of its crossings; they do not show how to stabilise it.
    gain_margin : float
        Factor of the gain at which the loop oscillates or drifts. Below 1 for a loop that needs
        its gain; ``inf`` if there is none.
    phase_margin : float
        Additional phase lag in degrees that the loop tolerates; ``inf`` if its gain is never 1.
    delay_margin : float
        Additional dead time in s that the loop tolerates; ``inf`` likewise, 0 if it is unstable.
    crossover_frequency : float
        Frequency in rad/s of loop gain 1, at the phase margin; ``nan`` if there is none.
    sensitivity_peak : float
        M_s, the largest |1/(1 + L)|; 1.2 to 2 is usual. It has no meaning for an unstable loop.
    """

    is_stable: bool
    gain_margin: float
    phase_margin: float
    delay_margin: float
    crossover_frequency: float
    sensitivity_peak: float


def compute_margins(identified: IdentifiedModel, control: PidControl) -> Margins:
    """Compute the margins of a loop of controller and model, without the controller's limits.

    Raises
    ------
    NotLinear
        If the model is not linear, or a recursion.
    """
    if is_difference(identified.model):
        raise NotLinear("margins need a model in the differential form; this one is a recursion")
    signals = (control.input, control.output)
    pairs = compute_transfer_functions(identified).pairs
    [pair] = [candidate for candidate in pairs if (candidate.input, candidate.output) == signals]
    loop = _LoopGain(pair, control)
    omega, end = _choose_frequencies(loop, pair, control)
    return _measure_margins(loop, omega[omega <= end], is_stable=_is_stable(loop, omega))


class _LoopGain:
    """Loop gain L(s) on the imaginary axis; weights of the reference are outside the loop."""

    def __init__(self, pair: TransferFunction, control: PidControl) -> None:
        self._pair, self._control = pair, control
        self._transport = control.transport or Transport()
        self.order = max(power for power, _ in pair.denominator)
        self.order += control.has_integral_action + control.has_derivative_action
        self.order += self._transport.time_constant > 0

    def evaluate_gain(self, omega: FloatArray) -> ComplexArray:
        """Evaluate L(iω): controller, transport and plant in series."""
        above, below = self.evaluate_fraction(omega)
        return above / below

    def evaluate_static_gain(self) -> FloatArray:
        """Evaluate L(0), a real number, (1,); empty if the loop integrates."""
        above, below = self.evaluate_fraction(np.zeros(1))
        gains: FloatArray = (above[below != 0] / below[below != 0]).real
        return gains[np.isfinite(gains)]

    def evaluate_fraction(self, omega: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """Evaluate numerator and denominator of L(iω), both without poles."""
        control, transport = self._control, self._transport
        s: ComplexArray = np.asarray(1j * omega, dtype=np.complex128)
        late: ComplexArray = np.exp(-s * transport.delay)
        below: ComplexArray = 1.0 + s * transport.time_constant
        filtered: ComplexArray = 1.0 + s * control.filter_time
        actions = filtered + s * control.derivative_time
        if control.has_integral_action and control.integral_time is not None:
            actions = actions * s + filtered / control.integral_time
            below = below * s
        controller = control.gain * transport.gain * late * actions
        above: ComplexArray = controller * _evaluate_quasi_polynomial(self._pair.numerator, s)
        return above, below * filtered * _evaluate_quasi_polynomial(self._pair.denominator, s)


def _evaluate_quasi_polynomial(quasi: QuasiPolynomial, s: ComplexArray) -> ComplexArray:
    total = np.zeros_like(s)
    for delay, powers in group_by_delay(quasi):
        total += np.polyval(powers, s) * np.exp(-s * delay)
    return total


def _is_stable(loop: _LoopGain, omega: FloatArray) -> bool:
    """Whether the loop is stable, by Mikhailov's criterion.

    The sum of numerator and denominator turns by a quarter for each stable root. It is divided by
    a polynomial with as many stable roots. Then it does not turn if all its roots are stable, and
    turns back by half a turn for each unstable root.
    """
    above, below = loop.evaluate_fraction(omega)
    middle = float(np.sqrt(omega[0] * omega[-1]))
    turned = np.unwrap(np.angle((above + below) / (1j * omega / middle + 1.0) ** loop.order))
    return bool(abs(turned[-1] - turned[0]) < pi / 2)


def _choose_frequencies(
    loop: _LoopGain, pair: TransferFunction, control: PidControl
) -> tuple[FloatArray, float]:
    """Choose angular frequencies for the loop, and the one above which its gain is negligible."""
    scales = sorted(_find_corner_frequencies(pair, control)) or [1.0]
    middle = scales[len(scales) // 2]
    scales = [
        min(max(frequency, middle / _MAX_FREQUENCY_RATIO), middle * _MAX_FREQUENCY_RATIO)
        for frequency in scales
    ]
    low, high = scales[0] / 10**_OUTER_DECADES, scales[-1] * 10**_OUTER_DECADES
    decades = np.log10(high / low)
    coarse: FloatArray = np.geomspace(low, high, ceil(_POINTS_PER_DECADE * decades))
    size = np.abs(loop.evaluate_gain(coarse))
    loud, end = (
        _find_last_frequency(coarse, size > _LOUD_GAIN, low),
        _find_last_frequency(coarse, size > _NEGLIGIBLE_GAIN, high),
    )
    delays = sum(
        max((d for _, d in polynomial), default=0.0)
        for polynomial in (pair.numerator, pair.denominator)
    )
    delays += control.transport.delay if control.transport else 0.0
    fine = (
        [
            _space_frequencies(0.0, loud, _MAX_TURN / delays),
            _space_frequencies(loud, end, _UNRESOLVED_TURN / delays),
        ]
        if delays
        else []
    )
    return _refine_frequencies(loop, np.unique(np.concatenate([coarse, *fine]))), end


def _find_last_frequency(omega: FloatArray, where: BoolArray, otherwise: float) -> float:
    """Find the frequency after the last one where a condition holds."""
    matches = np.flatnonzero(where)
    return float(omega[min(int(matches[-1]) + 2, omega.size - 1)]) if matches.size else otherwise


def _space_frequencies(start: float, stop: float, step: float) -> FloatArray:
    count = min(ceil((stop - start) / step), _MAX_FREQUENCIES) if stop > start else 0
    return np.linspace(stop, start, count, endpoint=False)


def _refine_frequencies(loop: _LoopGain, omega: FloatArray) -> FloatArray:
    """Add frequencies where a root near the axis turns the loop, or its border, abruptly.

    A root on the axis is never resolved. A root right of it by less than the last step may be
    taken for one left of it.
    """
    for _ in range(_MAX_REFINEMENTS):
        above, below = loop.evaluate_fraction(omega)
        steps = [np.diff(np.unwrap(np.angle(values))) for values in (below, above + below)]
        far = np.flatnonzero(np.max(np.abs(steps), axis=0) > _UNRESOLVED_TURN)
        if not 0 < far.size <= _MAX_UNRESOLVED_STEPS:
            break
        parts = np.linspace(0.0, 1.0, _REFINEMENT_PARTS, endpoint=False)[1:, None]
        added = omega[far] + parts * (omega[far + 1] - omega[far])
        omega = np.unique(np.concatenate([omega, added.ravel()]))
    return omega


def _find_corner_frequencies(pair: TransferFunction, control: PidControl) -> Iterable[float]:
    """Find the corner frequencies in rad/s."""
    for quasi in (pair.numerator, pair.denominator):
        for delay, powers in group_by_delay(quasi):
            yield from (abs(root) for root in np.roots(powers) if root != 0)
            if delay > 0:
                yield 1.0 / delay
    transport = control.transport or Transport()
    times = [transport.delay, transport.time_constant, control.filter_time, control.derivative_time]
    if control.has_integral_action and control.integral_time is not None:
        times.append(control.integral_time)
    yield from (1.0 / time for time in times if time > 0)


def _measure_margins(loop: _LoopGain, omega: FloatArray, *, is_stable: bool) -> Margins:
    gains = loop.evaluate_gain(omega)
    crossings = _find_sign_changes(
        lambda w: np.abs(loop.evaluate_gain(w)) - 1.0, omega, np.abs(gains) - 1.0
    )
    lefts = np.angle(-loop.evaluate_gain(crossings))
    if is_stable:  # beyond half a turn it is stable, because the next border is a turn away
        lefts = np.where(lefts < -_PHASE_ROUNDING, lefts + 2 * pi, lefts)
    nearest = int(np.argmin(np.abs(lefts))) if lefts.size else None
    turned = _find_sign_changes(lambda w: loop.evaluate_gain(w).imag, omega, gains.imag)
    at_turned = np.append(loop.evaluate_gain(turned).real, loop.evaluate_static_gain())
    factors = -1.0 / at_turned[at_turned < 0]
    delay_margin = float(np.min(np.maximum(lefts, 0.0) / crossings, initial=inf))
    return Margins(
        is_stable=is_stable,
        gain_margin=float(factors[np.argmin(np.abs(np.log(factors)))]) if factors.size else inf,
        phase_margin=inf if nearest is None else float(np.degrees(lefts[nearest])),
        delay_margin=delay_margin if is_stable else 0.0,
        crossover_frequency=np.nan if nearest is None else float(crossings[nearest]),
        sensitivity_peak=float(np.max(1.0 / np.abs(1.0 + gains))),
    )


def _find_sign_changes(
    function: Callable[[FloatArray], FloatArray], omega: FloatArray, values: FloatArray
) -> FloatArray:
    """Find where a function changes its sign, by secants of the steps in which it does."""
    before = np.flatnonzero(values[:-1] * values[1:] < 0)
    low, high, below, above = omega[before], omega[before + 1], values[before], values[before + 1]
    for _ in range(_SECANT_STEPS):
        middle = low - below * (high - low) / (above - below)
        value = function(middle)
        is_before = value * below > 0
        low, below = np.where(is_before, middle, low), np.where(is_before, value, below)
        high, above = np.where(is_before, high, middle), np.where(is_before, above, value)
    crossings: FloatArray = low - below * (high - low) / (above - below)
    return crossings
