"""Residuals laid out evenly, and their sums with lagged inputs, with the covariance of those."""

from typing import NamedTuple

import numpy as np
from numpy.fft import irfft, rfft

from sysid.records import Channel, sampling_of
from sysid.types import BoolArray, FloatArray

MAX_LAG = 25
FEWEST = 20
"""Samples: below, no test says anything."""

ROUNDING = 1e-9
"""Part of a signal below which what is left of it is rounding."""

_GRID = 0.05  # of a period: so far from its place a sample may lie
_GAPS = 0.5  # of the places of a grid are filled at least, else it is none


class Laid(NamedTuple):
    """Residuals one beside the other, zero where one is missing, with their times."""

    times: FloatArray
    values: FloatArray
    present: BoolArray
    period: float
    is_regular: bool

    @property
    def lags(self) -> int:
        """How many lags are looked at: 25, fewer of a short record."""
        return min(MAX_LAG, int(np.count_nonzero(self.present)) // 4)


def laid_out(times: FloatArray, values: FloatArray) -> Laid:
    """Residuals (N,) in places a period apart, those between missing; irregular ones in order."""
    steps = np.diff(times)
    period = float(np.median(steps)) if steps.size else 0.0
    if period > 0:
        rounded = np.cumsum(np.maximum(np.rint(steps / period), 0.0))
        period = float((times[-1] - times[0]) / rounded[-1])  # not off by the rounding of one step
        exact = np.concatenate([[0.0], steps / period])
        places = np.concatenate([[0.0], rounded])
        far = np.abs(exact - np.rint(exact))
        is_regular = bool(np.all(far <= _GRID) and np.all(np.rint(exact[1:]) >= 1))
        n = int(places[-1]) + 1
        if is_regular and values.size >= _GAPS * n:
            index = places.astype(np.intp)
            filled, present = np.zeros(n), np.zeros(n, dtype=np.bool_)
            filled[index], present[index] = values, True
            laid = times[0] + period * np.arange(n)
            laid[index] = times
            return Laid(laid, filled, present, period, is_regular=True)
    distinct = max(np.unique(times).size - 1, 1)
    spacing = float(times[-1] - times[0]) / distinct
    return Laid(times, values, np.ones(values.size, dtype=np.bool_), spacing, is_regular=False)


class Whiteness(NamedTuple):
    """Autocorrelation at the lags from 1, its standard deviation if white, Ljung and Box's Q."""

    values: FloatArray
    deviation: FloatArray
    statistic: float


def whiteness(laid: Laid) -> Whiteness:
    """How alike neighbouring residuals are, over `Laid.lags` lags; missing ones leave pairs out."""
    n = np.count_nonzero(laid.present)
    values = _products(laid.values, laid.lags) / float(laid.values @ laid.values)
    if n == laid.present.size:
        pairs = n - np.arange(1.0, laid.lags + 1)
    else:
        pairs = _products(laid.present.astype(np.float64), laid.lags)
    deviation = np.sqrt(np.maximum(pairs, 1) / (n * (n + 2.0)))
    return Whiteness(values, deviation, float(np.sum(np.square(values / deviation))))


def _products(values: FloatArray, lags: int) -> FloatArray:
    """Σ v(t) v(t + k) for k = 1 … lags."""
    return np.correlate(np.concatenate([values[1:], np.zeros(lags)]), values, "valid")


class LaggedSums(NamedTuple):
    """Sums Σ e(t) u(t - kτ) over some lags k: their norm, covariance and standard deviation."""

    lags: FloatArray
    sums: FloatArray
    norm: FloatArray
    covariance: FloatArray
    deviation: FloatArray


def lagged_sums(
    laid: Laid, residual: FloatArray, colour: FloatArray, channel: Channel, lags: FloatArray
) -> LaggedSums | str:
    """The sums over these lags, or why there are none."""
    shifted = _shifted(laid, channel, lags * laid.period)
    # Of every lag the same samples, so that no lag is judged by more than another.
    known = laid.present & np.all(np.isfinite(shifted), axis=0)
    if np.count_nonzero(known) < FEWEST:
        return "it overlaps the output too little"
    columns = np.where(known, shifted, 0.0)
    columns -= np.where(known, columns.sum(axis=1, keepdims=True) / known.sum(), 0.0)
    sizes = np.sqrt(np.sum(np.square(columns), axis=1))
    if not np.min(sizes) > ROUNDING * np.max(np.abs(channel.values)):
        return "the input is constant there"
    seen = rfft(columns, 2 * (colour.size - 1), axis=1) * colour
    covariance = np.asarray((seen @ seen.conj().T).real)
    norm = sizes * np.sqrt(float(residual[known] @ residual[known]))
    tiny = np.finfo(float).tiny
    deviation = np.sqrt(np.maximum(np.diag(covariance), tiny))
    return LaggedSums(lags, columns @ residual, np.maximum(norm, tiny), covariance, deviation)


def _shifted(laid: Laid, channel: Channel, lags: FloatArray) -> FloatArray:
    """The input at the residuals' times less each lag (s), (n, N); nan where not recorded."""
    # A jump and the sample it is seen at may be a rounding apart: nearer than this, they are one.
    slack = 1e-6 * laid.period
    wanted = laid.times - lags[:, None]
    first, last = channel.times[0] - slack, channel.times[-1] + slack
    if channel.hold == "zero":
        place = np.searchsorted(channel.times, wanted + slack, side="right") - 1
        values = channel.values[np.clip(place, 0, channel.times.size - 1)]
        period = sampling_of(channel.times).period
        last += period if np.isfinite(period) else 0.0  # the last value holds for a period
    else:
        values = np.interp(wanted, channel.times, channel.values)
    return np.asarray(np.where((wanted >= first) & (wanted <= last), values, np.nan))


def colour_of(residual: FloatArray, present: BoolArray) -> FloatArray:
    """Root of the smoothed spectrum of residuals (N,), one value for each frequency of a transform.

    The covariance of Σ e(i) a(i) and Σ e(i) b(i) over the noise e is the product of the transforms
    of a and b, each times this.
    """
    n = residual.size
    length = 1 << (2 * n - 1).bit_length()
    raw = irfft(np.square(np.abs(rfft(residual, length))), length)[:n]
    pairs = np.rint(irfft(np.square(np.abs(rfft(present.astype(float), length))), length)[:n])
    complete = np.where(pairs > 0, np.arange(n, 0.0, -1.0) / np.maximum(pairs, 1.0), 0.0)
    autocovariance = raw * complete / n  # as if no sample were missing
    kernel = np.zeros(length)
    kernel[:n] = autocovariance * _parzen(n, _width(autocovariance, n))
    kernel[length - n + 1 :] = kernel[1:n][::-1]
    spectrum = np.maximum(rfft(kernel).real, 0.0)
    spectrum[1:-1] *= 2.0  # each frequency stands for its negative too
    return np.asarray(np.sqrt(spectrum / length))


def _width(autocovariance: FloatArray, n: int) -> float:
    """Width of a Parzen window, by the rule of Andrews (1991) for first-order colour."""
    rho = float(np.clip(autocovariance[1] / autocovariance[0], -0.99, 0.99))
    curvature = 4.0 * rho**2 / (1.0 - rho) ** 4
    return float(np.clip(2.66 * (curvature * n) ** 0.2, n ** (1 / 3), 0.25 * n))


def _parzen(n: int, width: float) -> FloatArray:
    x = np.minimum(np.arange(n) / width, 1.0)
    return np.asarray(np.where(x <= 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * (1 - x) ** 3))
