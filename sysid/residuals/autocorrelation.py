"""Residuals laid out evenly, and their sums with lagged inputs, with the covariance of those."""

from functools import lru_cache
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.fft import irfft, rfft

from sysid.core.types import BoolArray, FloatArray, IntArray
from sysid.data.records import Channel, Hold, measure_sampling

MAX_LAG = 25
FEWEST_SAMPLES = 20
"""Samples: below, no test says anything."""

ROUNDING_SHARE = 1e-9
"""Part of a signal below which what is left of it is rounding."""

_GRID_TOLERANCE = 0.05  # of a period: so far from its place a sample may lie
_LEAST_FILLED = 0.5  # of the places of a grid are filled at least, else it is none


class SpacedResiduals(NamedTuple):
    """Residuals one beside the other, zero where one is missing, with their times."""

    times: FloatArray
    values: FloatArray
    present: BoolArray
    period: float
    is_regular: bool

    @property
    def n_lags(self) -> int:
        """How many lags are looked at: 25, fewer of a short record."""
        return min(MAX_LAG, int(np.count_nonzero(self.present)) // 4)


class _TimeGrid(NamedTuple):
    """Places a period apart: their times (N,), and which of them (n,) the samples have."""

    times: FloatArray
    places: IntArray
    period: float


def space_residuals(times: FloatArray, values: FloatArray) -> SpacedResiduals:
    """Residuals (N,) in places a period apart, those between missing; irregular ones in order."""
    grid = _find_time_grid(np.asarray(times, dtype=np.float64).tobytes())
    if grid is not None:
        filled, present = np.zeros(grid.times.size), np.zeros(grid.times.size, dtype=np.bool_)
        filled[grid.places], present[grid.places] = values, True
        return SpacedResiduals(grid.times, filled, present, grid.period, is_regular=True)
    distinct = max(np.unique(times).size - 1, 1)
    spacing = float(times[-1] - times[0]) / distinct
    return SpacedResiduals(
        times, values, np.ones(values.size, dtype=np.bool_), spacing, is_regular=False
    )


@lru_cache(maxsize=2)
def _find_time_grid(written: bytes) -> _TimeGrid | None:
    """The grid of some times (n,), given as their bytes; None if they lie on none.

    Kept for the runs of a sweep, whose residuals alone differ.
    """
    times = np.frombuffer(written)
    steps = np.diff(times)
    period = float(np.median(steps)) if steps.size else 0.0
    if not period > 0:
        return None
    rounded = np.cumsum(np.maximum(np.rint(steps / period), 0.0))
    period = float((times[-1] - times[0]) / rounded[-1])  # not off by the rounding of one step
    exact = np.concatenate([[0.0], steps / period])
    places = np.concatenate([[0.0], rounded])
    far = np.abs(exact - np.rint(exact))
    is_regular = bool(np.all(far <= _GRID_TOLERANCE) and np.all(np.rint(exact[1:]) >= 1))
    n = int(places[-1]) + 1
    if not (is_regular and times.size >= _LEAST_FILLED * n):
        return None
    taken = places.astype(np.intp)
    laid = times[0] + period * np.arange(n)
    laid[taken] = times
    for array in (laid, taken):
        array.flags.writeable = False
    return _TimeGrid(laid, taken, period)


class Whiteness(NamedTuple):
    """Autocorrelation at the lags from 1, its standard deviation if white, Ljung and Box's Q."""

    values: FloatArray
    deviation: FloatArray
    statistic: float


def compute_whiteness(laid: SpacedResiduals) -> Whiteness:
    """How alike neighbouring residuals are, over `SpacedResiduals.n_lags` lags; missing ones leave pairs out."""
    n = np.count_nonzero(laid.present)
    values = _sum_lagged_products(laid.values, laid.n_lags) / float(laid.values @ laid.values)
    if n == laid.present.size:
        pairs = n - np.arange(1.0, laid.n_lags + 1)
    else:
        pairs = _sum_lagged_products(laid.present.astype(np.float64), laid.n_lags)
    deviation = np.sqrt(np.maximum(pairs, 1) / (n * (n + 2.0)))
    return Whiteness(values, deviation, float(np.sum(np.square(values / deviation))))


def _sum_lagged_products(values: FloatArray, lags: int) -> FloatArray:
    """Σ v(t) v(t + k) for k = 1 … lags."""
    return np.correlate(np.concatenate([values[1:], np.zeros(lags)]), values, "valid")


class LaggedSums(NamedTuple):
    """Sums Σ e(t) u(t - kτ) over some lags k: their norm, covariance and standard deviation."""

    lags: FloatArray
    sums: FloatArray
    norm: FloatArray
    covariance: FloatArray
    deviation: FloatArray


def compute_lagged_sums(
    laid: SpacedResiduals,
    residual: FloatArray,
    colour: FloatArray,
    channel: Channel,
    lags: FloatArray,
) -> LaggedSums | str:
    """The sums over these lags, or why there are none."""
    floats = (laid.times, channel.times, channel.values, lags)
    shifted = _build_lagged_inputs(
        laid.present.tobytes(),
        laid.period,
        channel.hold,
        *(np.asarray(one, dtype=np.float64).tobytes() for one in floats),
    )
    if isinstance(shifted, str):
        return shifted
    columns, sizes, known = shifted
    seen = (rfft(columns, 2 * (colour.size - 1), axis=1) * colour).view(np.float64)
    covariance = seen @ seen.T  # real part of the product with the conjugate
    norm = sizes * np.sqrt(float(residual[known] @ residual[known]))
    tiny = np.finfo(float).tiny
    deviation = np.sqrt(np.maximum(np.diag(covariance), tiny))
    return LaggedSums(lags, columns @ residual, np.maximum(norm, tiny), covariance, deviation)


@lru_cache(maxsize=2)
def _build_lagged_inputs(
    present: bytes,
    period: float,
    hold: Hold,
    times: bytes,
    moments: bytes,
    values: bytes,
    lags: bytes,
) -> tuple[FloatArray, FloatArray, BoolArray] | str:
    """The lagged input without its mean (n, N), the lengths (n,), and which samples are known.

    Or why there is none. Kept for the runs of a sweep, whose residuals alone differ. The bytes are
    of arrays: `Laid.times` and `Laid.present`, times and values of the input, lags in periods.
    """
    there = np.frombuffer(present, dtype=np.bool_)
    laid = SpacedResiduals(np.frombuffer(times), np.zeros(0), there, period, is_regular=True)
    channel = Channel("", np.frombuffer(moments), np.frombuffer(values), hold=hold)
    shifted = _shift_input(laid, channel, np.frombuffer(lags) * period)
    # Of every lag the same samples, so that no lag is judged by more than another.
    known = there & np.isfinite(shifted.sum(axis=0))
    if np.count_nonzero(known) < FEWEST_SAMPLES:
        return "it overlaps the output too little"
    columns = np.where(known, shifted, 0.0)
    columns -= np.outer(columns.sum(axis=1) / np.count_nonzero(known), known)
    sizes = np.sqrt(np.einsum("kn,kn->k", columns, columns))
    if not np.min(sizes) > ROUNDING_SHARE * np.max(np.abs(channel.values)):
        return "the input is constant there"
    for array in (columns, sizes, known):
        array.flags.writeable = False
    return columns, sizes, known


def _shift_input(laid: SpacedResiduals, channel: Channel, lags: FloatArray) -> FloatArray:
    """The input at the residuals' times less each lag (s), (n, N); nan where not recorded."""
    # A jump and the sample it is seen at may be a rounding apart: nearer than this, they are one.
    slack = 1e-6 * laid.period
    wanted = laid.times - lags[:, None]
    first, last = channel.times[0] - slack, channel.times[-1] + slack
    if channel.hold == "zero":
        place = np.searchsorted(channel.times, wanted + slack, side="right") - 1
        values = channel.values[np.clip(place, 0, channel.times.size - 1)]
        period = measure_sampling(channel.times).period
        last += period if np.isfinite(period) else 0.0  # the last value holds for a period
    else:
        values = np.interp(wanted, channel.times, channel.values)
    return np.asarray(np.where((wanted >= first) & (wanted <= last), values, np.nan))


def smooth_spectrum_root(
    residual: FloatArray, present: BoolArray, room: int | None = None
) -> FloatArray:
    """Root of the smoothed spectrum of residuals (N,), one value for each frequency of a transform.

    The covariance of Σ e(i) a(i) and Σ e(i) b(i) over the noise e is the product of the transforms
    of a and b, each times this. The transform is `room` samples longer than the record, or as many
    as the window reaches: beyond, the record's beginning would be neighbour to its end.
    """
    n = residual.size
    width = _choose_window_width(residual, present)
    reach = min(ceil(width), n - 1)
    length = pad_length(n + (reach if room is None else max(reach, room)))
    autocovariance = _autocorrelate(residual, length)[: reach + 1] / n
    if not present.all():
        pairs = np.rint(_autocorrelate(present.astype(np.float64), length)[: reach + 1])
        complete = np.arange(n, n - reach - 1.0, -1.0) / np.maximum(pairs, 1.0)
        autocovariance *= np.where(pairs > 0, complete, 0.0)  # as if no sample were missing
    kernel = np.zeros(length)
    kernel[: reach + 1] = autocovariance * _make_parzen_window(reach + 1, width)
    kernel[length - reach :] = kernel[1 : reach + 1][::-1]
    spectrum = np.maximum(rfft(kernel).real, 0.0)
    spectrum[1:-1] *= 2.0  # each frequency stands for its negative too
    return np.asarray(np.sqrt(spectrum / length))


def _autocorrelate(values: FloatArray, length: int) -> FloatArray:
    """Σ v(t) v(t + k) for k from 0 on; right as long as the transform has room for k."""
    seen = rfft(values, length)
    return irfft(np.square(seen.real) + np.square(seen.imag), length)


def pad_length(least: int) -> int:
    """The next even length that a fast transform likes: a power of two times 1, 3, 5, 9 or 15."""
    return min(one << max(1, (-(-least // one) - 1).bit_length()) for one in (1, 3, 5, 9, 15))


def _choose_window_width(residual: FloatArray, present: BoolArray) -> float:
    """Width of a Parzen window, by the rule of Andrews (1991) for first-order colour."""
    n = residual.size
    pairs = max(int(np.count_nonzero(present[1:] & present[:-1])), 1)
    alike = float(residual[1:] @ residual[:-1]) * (n - 1) / pairs
    power = max(float(residual @ residual), np.finfo(float).tiny) * n / np.count_nonzero(present)
    rho = min(max(alike / power, -0.99), 0.99)
    curvature = 4.0 * rho**2 / (1.0 - rho) ** 4
    return float(np.clip(2.66 * (curvature * n) ** 0.2, n ** (1 / 3), 0.25 * n))


def _make_parzen_window(n: int, width: float) -> FloatArray:
    x = np.minimum(np.arange(n) / width, 1.0)
    return np.asarray(np.where(x <= 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * (1 - x) ** 3))
