"""Evenly spaced residuals, their autocorrelation, and their sums with lagged inputs."""

from functools import lru_cache
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.fft import irfft, rfft
from numpy.typing import NDArray

from sysid.core.types import BoolArray, FloatArray, IntArray
from sysid.data.records import Channel, Hold, measure_sampling

MAX_LAG = 25
MIN_SAMPLES = 20
"""Least number of samples for a test."""

ROUNDING_SHARE = 1e-9
"""Share of a signal below which a remainder is rounding."""

_GRID_TOLERANCE = 0.05  # of a period: largest distance of a sample from its grid point
_MAX_TRANSFORMS = 4  # of lagged inputs that are kept
_TINY = float(np.finfo(float).tiny)
_MIN_FILLED_SHARE = 0.5  # of the points of a grid must be filled


class SpacedResiduals(NamedTuple):
    """Evenly spaced residuals with their times; zero where a sample is missing."""

    times: FloatArray
    values: FloatArray
    present: BoolArray
    period: float
    is_regular: bool

    @property
    def n_lags(self) -> int:
        """Number of lags to test: 25, fewer for a short record."""
        return min(MAX_LAG, int(np.count_nonzero(self.present)) // 4)


class _TimeGrid(NamedTuple):
    """Grid points one period apart: times (N,), and the point of each of n samples."""

    times: FloatArray
    indices: IntArray
    period: float


def space_residuals(times: FloatArray, values: FloatArray) -> SpacedResiduals:
    """Space residuals (N,) one period apart with gaps; irregular ones stay in order."""
    grid = _find_time_grid(np.asarray(times, dtype=np.float64).tobytes())
    if grid is not None:
        spaced, present = np.zeros(grid.times.size), np.zeros(grid.times.size, dtype=np.bool_)
        spaced[grid.indices], present[grid.indices] = values, True
        return SpacedResiduals(grid.times, spaced, present, grid.period, is_regular=True)
    distinct = max(np.unique(times).size - 1, 1)
    spacing = float(times[-1] - times[0]) / distinct
    return SpacedResiduals(
        times, values, np.ones(values.size, dtype=np.bool_), spacing, is_regular=False
    )


def keep_in_order(values: FloatArray) -> SpacedResiduals:
    """Take residuals (N,) as evenly spaced, in their order."""
    present = np.ones(values.size, dtype=np.bool_)
    return SpacedResiduals(np.arange(float(values.size)), values, present, 1.0, is_regular=True)


@lru_cache(maxsize=2)
def _find_time_grid(time_bytes: bytes) -> _TimeGrid | None:
    """Find the grid of times (n,), passed as bytes; None if they are on no grid.

    The cache serves the runs of a sweep, which differ in their residuals only.
    """
    times = np.frombuffer(time_bytes)
    steps = np.diff(times)
    period = float(np.median(steps)) if steps.size else 0.0
    if not period > 0:
        return None
    rounded = np.cumsum(np.maximum(np.rint(steps / period), 0.0))
    period = float((times[-1] - times[0]) / rounded[-1])  # without the rounding error of one step
    exact = np.concatenate([[0.0], steps / period])
    positions = np.concatenate([[0.0], rounded])
    distance = np.abs(exact - np.rint(exact))
    is_regular = bool(np.all(distance <= _GRID_TOLERANCE) and np.all(np.rint(exact[1:]) >= 1))
    n = int(positions[-1]) + 1
    if not (is_regular and times.size >= _MIN_FILLED_SHARE * n):
        return None
    indices = positions.astype(np.intp)
    grid_times = times[0] + period * np.arange(n)
    grid_times[indices] = times
    for array in (grid_times, indices):
        array.flags.writeable = False
    return _TimeGrid(grid_times, indices, period)


class Whiteness(NamedTuple):
    """Autocorrelation from lag 1, its standard deviation for white residuals, Ljung–Box Q."""

    values: FloatArray
    deviation: FloatArray
    statistic: float


def compute_whiteness(spaced: SpacedResiduals) -> Whiteness:
    """Compute the autocorrelation over `SpacedResiduals.n_lags` lags, without missing samples."""
    n, lags = int(np.count_nonzero(spaced.present)), spaced.n_lags
    values = _sum_lagged_products(spaced.values, lags) / float(spaced.values @ spaced.values)
    if n == spaced.present.size:
        deviation = _compute_deviation(n, lags)
    else:
        pairs = _sum_lagged_products(spaced.present.astype(np.float64), lags)
        deviation = _scale_deviation(n, pairs)
    return Whiteness(values, deviation, float(np.sum(np.square(values / deviation))))


@lru_cache(maxsize=8)
def _compute_deviation(n: int, lags: int) -> FloatArray:
    """Compute the deviation over some lags of a series without gaps; the runs of a sweep share it.

    The result is read-only.
    """
    deviation = _scale_deviation(n, n - np.arange(1.0, lags + 1))
    deviation.flags.writeable = False
    return deviation


def _scale_deviation(n: int, pairs: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.maximum(pairs, 1) / (n * (n + 2.0))))


def _sum_lagged_products(values: FloatArray, lags: int) -> FloatArray:
    """Compute Σ v(t) v(t + k) for k = 1 … lags."""
    return np.correlate(np.concatenate([values[1:], np.zeros(lags)]), values, "valid")


class LaggedSums(NamedTuple):
    """Sums Σ e(t) u(t - kτ) over some lags k: their norm, covariance and standard deviation."""

    lags: FloatArray
    sums: FloatArray
    norm: FloatArray
    covariance: FloatArray
    deviation: FloatArray


def compute_lagged_sums(
    spaced: SpacedResiduals,
    residual: FloatArray,
    colour: FloatArray,
    channel: Channel,
    lags: FloatArray,
) -> LaggedSums | str:
    """Compute the sums over some lags, or the reason why there are none."""
    channel = channel.acting
    floats = (spaced.times, channel.times, channel.values, lags)
    shifted = _build_lagged_inputs(
        spaced.present.tobytes(),
        spaced.period,
        channel.effective_hold,
        *(np.asarray(array, dtype=np.float64).tobytes() for array in floats),
    )
    if isinstance(shifted, str):
        return shifted
    columns, sizes, is_used, _ = shifted
    weighted = (shifted.transform(2 * (colour.size - 1)) * colour).view(np.float64)
    covariance = weighted @ weighted.T  # real part of the product with the conjugate
    norm = sizes * np.sqrt(float(residual[is_used] @ residual[is_used]))
    deviation = np.sqrt(np.maximum(covariance.diagonal(), _TINY))
    return LaggedSums(lags, columns @ residual, np.maximum(norm, _TINY), covariance, deviation)


class _LaggedInputs(NamedTuple):
    """Lagged inputs without mean (n, N), their norms (n,), and the known samples (N,).

    `transforms` holds their transforms by length.
    """

    columns: FloatArray
    sizes: FloatArray
    is_used: BoolArray
    transforms: dict[int, NDArray[np.complex128]]

    def transform(self, length: int) -> NDArray[np.complex128]:
        """Transform the inputs over some length: the same for most runs of a sweep."""
        if length not in self.transforms:
            if len(self.transforms) == _MAX_TRANSFORMS:
                self.transforms.clear()
            self.transforms[length] = rfft(self.columns, length, axis=1)
        return self.transforms[length]


@lru_cache(maxsize=2)
def _build_lagged_inputs(
    present: bytes,
    period: float,
    hold: Hold,
    times: bytes,
    input_times: bytes,
    values: bytes,
    lags: bytes,
) -> _LaggedInputs | str:
    """Build the lagged inputs, or return the reason why there are none.

    The cache serves the runs of a sweep, which differ in their
    residuals only. The bytes are those of arrays: `SpacedResiduals.times` and
    `SpacedResiduals.present`, times and values of the input, lags in periods.
    """
    is_present = np.frombuffer(present, dtype=np.bool_)
    spaced = SpacedResiduals(np.frombuffer(times), np.zeros(0), is_present, period, is_regular=True)
    channel = Channel("", np.frombuffer(input_times), np.frombuffer(values), hold=hold)
    shifted = _shift_input(spaced, channel, np.frombuffer(lags) * period)
    # All lags use the same samples, so that none has more than another.
    is_used = is_present & np.isfinite(shifted.sum(axis=0))
    if np.count_nonzero(is_used) < MIN_SAMPLES:
        return "it overlaps the output too little"
    columns = np.where(is_used, shifted, 0.0)
    columns -= np.outer(columns.sum(axis=1) / np.count_nonzero(is_used), is_used)
    sizes = np.sqrt(np.einsum("kn,kn->k", columns, columns))
    if not np.min(sizes) > ROUNDING_SHARE * np.max(np.abs(channel.values)):
        return "the input is constant there"
    for array in (columns, sizes, is_used):
        array.flags.writeable = False
    return _LaggedInputs(columns, sizes, is_used, {})


def _shift_input(spaced: SpacedResiduals, channel: Channel, lags: FloatArray) -> FloatArray:
    """Read the input at the residuals' times minus each lag (s), (n, N); nan: not recorded."""
    # A jump and its sample can differ by rounding. Nearer than this, they coincide.
    slack = 1e-6 * spaced.period
    read_times = spaced.times - lags[:, None]
    first, last = channel.times[0] - slack, channel.times[-1] + slack
    if channel.hold == "zero":
        index = np.searchsorted(channel.times, read_times + slack, side="right") - 1
        values = channel.values[np.clip(index, 0, channel.times.size - 1)]
        period = measure_sampling(channel.times).period
        last += period if np.isfinite(period) else 0.0  # the last value holds for a period
    else:
        values = np.interp(read_times, channel.times, channel.values)
    return np.asarray(np.where((read_times >= first) & (read_times <= last), values, np.nan))


def smooth_spectrum_root(
    residual: FloatArray, present: BoolArray, room: int | None = None
) -> FloatArray:
    """Compute the root of the smoothed spectrum of residuals (N,) at the frequencies of an FFT.

    Multiply the transforms of a and b by this root. Their product is then the covariance of
    Σ e(i) a(i) and Σ e(i) b(i) for noise e. The transform is `room` samples longer than the record,
    at least as many as the window reaches. Otherwise the end of the record would wrap around to
    its beginning.
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
    """Compute Σ v(t) v(t + k) from k = 0; correct while the transform has room for k."""
    transform = rfft(values, length)
    return irfft(np.square(transform.real) + np.square(transform.imag), length)


@lru_cache(maxsize=8)
def pad_length(least: int) -> int:
    """Return the next even length for a fast transform: a power of 2 times 1, 3, 5, 9 or 15."""
    return min(
        factor << max(1, (-(-least // factor) - 1).bit_length()) for factor in (1, 3, 5, 9, 15)
    )


def _choose_window_width(residual: FloatArray, present: BoolArray) -> float:
    """Choose the width of a Parzen window by the AR(1) rule of Andrews (1991)."""
    n = residual.size
    pairs = max(int(np.count_nonzero(present[1:] & present[:-1])), 1)
    product = float(residual[1:] @ residual[:-1]) * (n - 1) / pairs
    power = max(float(residual @ residual), _TINY) * n / np.count_nonzero(present)
    rho = min(max(product / power, -0.99), 0.99)
    curvature = 4.0 * rho**2 / (1.0 - rho) ** 4
    width = 2.66 * (curvature * n) ** 0.2
    return float(min(max(width, n ** (1 / 3)), 0.25 * n))


def _make_parzen_window(n: int, width: float) -> FloatArray:
    x = np.minimum(np.arange(n) / width, 1.0)
    return np.asarray(np.where(x <= 0.5, 1 - 6 * x**2 + 6 * x**3, 2 * (1 - x) ** 3))
