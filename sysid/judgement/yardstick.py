"""A yardstick: a linear black box, fitted in milliseconds and compared with the user's model.

For every output, linear models of order 1 to 4 with a time lag for each input are fitted by their
simulation error (output error, Ljung 1999, ch. 10). So noise at the output, however coloured, makes
no bias. The inputs share the poles. Numerators, starts and an offset enter linearly and are
projected out (Golub and Pereyra 1973); poles and time lags are moved by Levenberg–Marquardt. The
starting points are the peaks of a scan: shapes of one or two poles by all time lags, by FFT.

The order is the one whose left-out blocks are simulated best. Blocks are left out linearly first,
as in Allen's PRESS (Technometrics 16 (1974) 125). For the best orders they are really left out:
poles and lags take a Gauss–Newton step without a block, the linear part is fitted without it, and
the whole record is simulated. The block is compared with that. The user's model is compared on
the same samples, but it was fitted to them too. So it is at an advantage, and what is said against
it is safe. Time lags, shapes and orders were chosen with all blocks, and the best of many choices
fits even noise. So the logarithm of their number is subtracted from the gain (Bonferroni).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.fft import irfft, rfft

from sysid.core.types import BoolArray, ComplexArray, FloatArray, IntArray
from sysid.data.records import Channel, Record
from sysid.residuals.autocorrelation import (
    ROUNDING_SHARE,
    pad_length,
    space_residuals,
)
from sysid.simulation.fit_metrics import EXPLAINED_PERCENT, rms
from sysid.simulation.problem import Problem

ORDERS = (1, 2, 3, 4)
"""Orders that are tried."""

CLEAR_GAIN = log(20.0)
"""Gain from which on a yardstick is clearly better: odds of 20 : 1.

The true model was never called worse in 575 records of linear and nonlinear plants, half of them
with AR(1) noise of correlation times up to a twelfth of the record. The largest gain was -5.
"""

NOTABLE_SHARE = 0.15
"""Share of the mean square error of the user's model that a notable yardstick saves.

It is a measure of importance, not of chance. It is 8 % of the RMS error.
"""

_BLOCKS = 10  # left out in turn, over all experiments
_WARM_UP = 0.1  # of every experiment: it tells where the states start, and is not compared
_ROWS_PER_PARAMETER = 5
_MIN_SAMPLES = 40
_LEAST_SHARE = 0.5  # of the samples must be compared
_MOST_POINTS = 50_000  # of the grids of all inputs: a longer record is averaged
_ROWS = 500  # rows of a fit: a longer record is averaged, if its dynamics are slow enough
_STEPS_PER_TIME_CONSTANT = 12.0  # of the averaged record
_LONGEST_DELAY = 1.0 / 3.0  # of the record
_SLOWEST = 100.0  # records: a longer time constant is an integrator
_SLOW_SHARE = 1.0 / 3.0  # of the record: only one time constant may be longer
_FASTEST = 3.0  # per step: a faster pole is a static gain
_DAMPING = (0.005, 30.0)
_SCANNED_DAMPING = (0.1, 0.4, 1.2)
_SHAPES_PER_DECADE = 3
_NEW_POLES = 5  # rates at which a new pole is tried
_START_ROWS = 200  # by which starts are compared
_SCANNED_DELAYS = (1.0, 0.7, 0.3, 0.0)  # of the delays of one order less
_EVALUATIONS = 14  # of the columns, for each order
_CONVERGED = 1e-3  # relative decrease of the squares
_WORTHWHILE = 0.99  # of the squares: less is worth another order
_STEP_SHARES = (1.0, 0.5, 0.2)  # of a step without a block, until it lowers the squares
_DIFFERENCE = 1e-3  # of a logarithm, for slopes by differences
_START_RIDGE = 1e-3  # noise over the prior deviation of a start, both in deviations of the output
_RIDGE = 1e-7  # of a column, against rounding


@dataclass(frozen=True, slots=True)
class Yardstick:
    """A linear model and the user's, compared on blocks that only the linear one did not see.

    Attributes
    ----------
    output : str
    order : int
        Number of poles.
    delays : mapping of str to float
        Time lag (s) by input that moves.
    samples : int
        Samples that are compared.
    fit_percent, own_fit_percent : float
        Fit (%) of the linear model on left-out blocks, and of the user's on the same samples.
    rms, own_rms : float
        RMS error of both, in the unit of the output.
    gain : float
        Logarithm of the likelihood ratio, from as many samples as are independent, less that of the
        number of linear models that were tried.
    """

    output: str
    order: int
    delays: Mapping[str, float]
    samples: int
    fit_percent: float
    own_fit_percent: float
    rms: float
    own_rms: float
    gain: float

    @property
    def saved_share(self) -> float:
        """Share of the user's mean square error that the linear model saves; negative: it adds."""
        return 1.0 - (self.rms / self.own_rms) ** 2

    @property
    def is_clearly_better(self) -> bool:
        """Whether the linear model is better beyond chance, and by a notable share."""
        return self.gain > CLEAR_GAIN and self.saved_share > NOTABLE_SHARE


def fit_yardstick(problem: Problem, simulated: FloatArray) -> Yardstick | None:
    """Fit linear models to each output and compare the best with the user's model.

    Every output is explained by all inputs. That of the largest gain is returned.

    Parameters
    ----------
    problem : Problem
    simulated : FloatArray, shape (M,)
        Values that the user's model simulates at the measured times.

    Returns
    -------
    Yardstick or None
        None if no input moves, no output has 40 samples, or the user's model diverged or leaves
        errors of the solver only.
    """
    tables = [_read_outputs(problem, simulated, name) for name in problem.output_weights]
    compared = [_compare(problem.records, table) for table in tables if table is not None]
    known = [yardstick for yardstick in compared if yardstick is not None]
    return max(known, key=lambda one: (one.is_clearly_better, one.gain), default=None)


class _Samples(NamedTuple):
    """Scored samples (N,) of an output: experiment, time (s), measured and simulated value."""

    output: str
    experiment: IntArray
    times: FloatArray
    measured: FloatArray
    simulated: FloatArray


def _read_outputs(problem: Problem, simulated: FloatArray, name: str) -> _Samples | None:
    """Read the scored samples of an output; None if they are too few or explained."""
    parts = zip(
        problem.records,
        problem.split_by_output(problem.evaluator.measured),
        problem.split_by_output(problem.evaluator.weight),
        problem.split_by_output(simulated),
        strict=True,
    )
    columns = list[tuple[FloatArray, ...]]()
    for number, (record, values, weights, model) in enumerate(parts):
        [times] = [channel.times for channel in record.outputs if channel.name == name]
        scored = weights[name] > 0
        experiment = np.full(times.size, float(number))
        columns.append(tuple(c[scored] for c in (experiment, times, values[name], model[name])))
    experiment, times, measured, own = (np.concatenate(c) for c in zip(*columns, strict=True))
    if times.size < _MIN_SAMPLES or not np.all(np.isfinite(own)):
        return None
    spread = float(np.std(measured))
    if spread <= ROUNDING_SHARE * float(np.max(np.abs(measured))):
        return None
    if rms(measured - own) <= (1.0 - EXPLAINED_PERCENT / 100.0) * spread:
        return None
    return _Samples(name, experiment.astype(np.int64), times, measured, own)


class _Rows(NamedTuple):
    """Rows (R,) of a fit: experiment, position on the grid, centred value, root of the weight.

    `block` is the block that a row is in, -1 where it is never left out.
    """

    experiment: IntArray
    position: FloatArray
    value: FloatArray
    root: FloatArray
    block: IntArray


class _Grid(NamedTuple):
    """Inputs on a regular grid, with their transforms.

    Attributes
    ----------
    step : float
        In s.
    first : int
        Grid point at which the records begin; the input is known before it.
    inputs : FloatArray, shape (E, U, G)
        Means over the step before a grid point, from their first value, of unit size.
    spectra : FloatArray, shape (E, U, F)
    length : int
        Of the transforms: the double of G at least.
    """

    step: float
    first: int
    inputs: FloatArray
    spectra: ComplexArray
    length: int

    @property
    def points(self) -> int:
        """G: points of the grid."""
        return int(self.inputs.shape[2])

    @property
    def longest_delay(self) -> int:
        """Longest time lag that is tried, in steps."""
        return max(int(_LONGEST_DELAY * (self.points - self.first)), 1)

    @property
    def slowest_rate(self) -> float:
        """Rate of the slowest pole, per step."""
        return 1.0 / (_SLOWEST * self.points)


def _compare(records: Sequence[Record], samples: _Samples) -> Yardstick | None:
    """Fit linear models to one output and compare; None if too little can be compared."""
    moving = _list_moving_inputs(records)
    if not moving:
        return None
    period, spans = _measure_period(samples, len(records))
    points = float(np.max(spans)) / period * len(records) * len(moving)
    stride = max(int(np.ceil(points / _MOST_POINTS)), 1)
    placed = _place(records, moving, samples, period, stride)
    slower = _choose_stride(placed.grid, placed.rows)
    if slower > 1:
        placed = _place(records, moving, samples, period, slower * stride)
    grid, rows, every = placed
    best, least = None, np.inf
    for fit in reversed(_fit_orders(grid, rows)):
        simulated = _simulate_left_out(grid, rows, fit, every)
        square = _compute_mean_square(simulated, every)
        if square >= least:
            break
        best, least = (fit, simulated), square
    if best is None:
        return None
    fit, simulated = best
    delays = dict(zip(moving, np.maximum(fit.delays * grid.step, 0.0).tolist(), strict=True))
    yardstick = _assess(samples, simulated, fit.shape.size, delays)
    if yardstick is None:
        return None
    return replace(yardstick, gain=yardstick.gain - _count_choices(grid))


def _count_choices(grid: _Grid) -> float:
    """Count the time lags and shapes that were tried for each input, and the orders: logarithm."""
    rates = _list_rates(grid).size
    each = (grid.longest_delay + 1) * rates * (1 + len(_SCANNED_DAMPING))
    return log(len(ORDERS)) + int(grid.inputs.shape[1]) * log(each)


def _compute_mean_square(simulated: FloatArray, every: _Rows) -> float:
    """Compute the mean square error of left-out blocks; infinite if most are not told."""
    told = np.isfinite(simulated)
    if np.mean(told) < _LEAST_SHARE:
        return float(np.inf)
    return float(np.mean(np.square(every.value[told] - simulated[told])))


class _Placed(NamedTuple):
    """Samples on a grid: the rows of a fit, which may be averages, and every sample."""

    grid: _Grid
    rows: _Rows
    every: _Rows


def _place(
    records: Sequence[Record],
    moving: Sequence[str],
    samples: _Samples,
    period: float,
    stride: int,
) -> _Placed:
    """Place the samples on a grid whose step is `stride` sampling periods (s)."""
    starts = np.zeros(len(records))
    for number in np.unique(samples.experiment):
        starts[number] = samples.times[samples.experiment == number][0]
    grid = _make_grid(records, moving, samples, starts, stride * period)
    every = _Rows(
        samples.experiment,
        (samples.times - starts[samples.experiment]) / grid.step + grid.first,
        (samples.measured - np.mean(samples.measured)) / np.std(samples.measured),
        np.ones(samples.times.size),
        _split_blocks(samples, len(records)),
    )
    return _Placed(grid, every if stride == 1 else _average(every), every)


def _measure_period(samples: _Samples, experiments: int) -> tuple[float, FloatArray]:
    """Measure the sampling period (s), and how long each experiment lasts (E,).

    The period is the median distance, or longer if most samples are missing.
    """
    spans = np.zeros(experiments)
    steps = [np.zeros(0)]
    for number in np.unique(samples.experiment):
        times = samples.times[samples.experiment == number]
        spans[number] = times[-1] - times[0]
        steps.append(np.diff(times))
    distances = np.concatenate(steps)
    distances = distances[distances > 0]
    if not distances.size:
        return 1.0, spans
    period = max(float(np.median(distances)), float(np.sum(spans)) / (2 * samples.times.size))
    return period, spans


def _assess(
    samples: _Samples, simulated: FloatArray, order: int, delays: Mapping[str, float]
) -> Yardstick | None:
    """Compare both models on left-out samples; None if most are not told, or do not move.

    `simulated` (N,) is centred and of unit size, as the rows are, and nan where it is not told.
    """
    is_compared = np.isfinite(simulated)
    if np.mean(is_compared) < _LEAST_SHARE:
        return None
    predicted = np.mean(samples.measured) + np.std(samples.measured) * simulated
    experiments = samples.experiment[is_compared]
    measured = samples.measured[is_compared]
    power = sum(_sum_centred(measured[experiments == e]) for e in np.unique(experiments))
    own_errors = measured - samples.simulated[is_compared]
    errors = measured - predicted[is_compared]
    if min(power, float(own_errors @ own_errors), float(errors @ errors)) <= 0.0:
        return None
    return Yardstick(
        samples.output,
        order,
        delays,
        int(measured.size),
        100.0 * (1.0 - sqrt(float(errors @ errors) / power)),
        100.0 * (1.0 - sqrt(float(own_errors @ own_errors) / power)),
        rms(errors),
        rms(own_errors),
        _compute_gain(experiments, samples.times[is_compared], own_errors, errors),
    )


def _sum_centred(values: FloatArray) -> float:
    return float(np.sum(np.square(values - np.mean(values))))


def _compute_gain(
    experiments: IntArray, times: FloatArray, own_errors: FloatArray, errors: FloatArray
) -> float:
    """Compute the logarithm of the likelihood ratio, from as many samples as are independent.

    For Gaussian noise of unknown size it is ν/2 times the logarithm of the ratio of both mean
    squares, without a penalty, because the samples were left out. As the residuals of the user's
    model have a colour, ν is the number of white samples whose variance is as uncertain: n / Σ ρ²
    (Bayley and Hammersley, J. R. Statist. Soc. Suppl. 8 (1946) 184), here with the sum over all
    lags ρ by the periodogram. That counts a misfit as colour, so it is too small rather than too
    large.
    """
    square = fourth = 0.0
    for number in np.unique(experiments):
        own = experiments == number
        spaced = space_residuals(times[own], own_errors[own])
        power = np.square(np.abs(rfft(spaced.values)))
        square += float(np.sum(power))
        fourth += float(np.sum(np.square(power)))
    independent = min(4.0 * square**2 / fourth, float(errors.size)) if fourth > 0 else 0.0
    return 0.5 * independent * log(rms(own_errors) ** 2 / rms(errors) ** 2)


def _list_moving_inputs(records: Sequence[Record]) -> list[str]:
    """List the inputs that move in some record."""
    names = dict.fromkeys(channel.name for record in records for channel in record.inputs)
    return [
        name
        for name in names
        if any(
            np.ptp(values) > ROUNDING_SHARE * np.max(np.abs(values))
            for record in records
            for channel in record.inputs
            if channel.name == name
            for values in [channel.history_and_samples.values]
        )
    ]


def _make_grid(
    records: Sequence[Record],
    moving: Sequence[str],
    samples: _Samples,
    starts: FloatArray,
    step: float,
) -> _Grid:
    """Place the inputs on a grid that begins, for each experiment, at its first sample."""
    ends = np.array(
        [np.max(samples.times[samples.experiment == e], initial=0.0) for e in range(len(records))]
    )
    spans = np.maximum(ends - starts, 0.0)
    points = int(np.ceil(np.max(spans) / step)) + 3
    before = max(start - _find_first_time(r) for start, r in zip(starts, records, strict=True))
    if len(records) > 1:  # each starts where its input was held, at a value of its own
        before = _LONGEST_DELAY * points * step
    first = int(np.clip(before / step, 0.0, _LONGEST_DELAY * points))
    inputs = np.zeros((len(records), len(moving), first + points))
    for number, record in enumerate(records):
        edges = starts[number] + step * (np.arange(first + points + 1.0) - first - 1.0)
        for channel in record.inputs:
            if channel.name in moving:
                inputs[number, moving.index(channel.name)] = _average_input(channel, edges)
    inputs -= np.mean(inputs[:, :, :1], axis=0)
    sizes = np.sqrt(np.mean(np.square(inputs), axis=(0, 2), keepdims=True))
    inputs /= np.where(sizes > 0, sizes, 1.0)
    length = pad_length(2 * (first + points))
    return _Grid(step, first, inputs, rfft(inputs, length, axis=2), length)


def _find_first_time(record: Record) -> float:
    return min(
        (channel.history_and_samples.times[0] for channel in record.inputs), default=record.start
    )


def _average_input(channel: Channel, edges: FloatArray) -> FloatArray:
    """Average an input between the edges (G + 1,); its ends are held outside the record."""
    whole = channel.history_and_samples
    known = np.isfinite(whole.values)
    times, values = whole.times[known], whole.values[known]
    gaps = np.diff(times)
    is_held = channel.effective_hold == "zero"
    heights = values[:-1] if is_held else 0.5 * (values[1:] + values[:-1])
    knots = np.concatenate([[0.0], np.cumsum(heights * gaps)])
    inside = np.clip(edges, times[0], times[-1])
    index = np.clip(np.searchsorted(times, inside, side="right") - 1, 0, max(times.size - 2, 0))
    since = inside - times[index]
    heights = values[index]
    if not is_held and times.size > 1:
        slopes = np.diff(values) / np.where(gaps > 0, gaps, 1.0)
        heights = heights + 0.5 * slopes[index] * since
    integral = knots[index] + heights * since
    integral += values[0] * np.minimum(edges - times[0], 0.0)
    integral += values[-1] * np.maximum(edges - times[-1], 0.0)
    return np.asarray(np.diff(integral) / np.diff(edges))


def _split_blocks(samples: _Samples, experiments: int) -> IntArray:
    """Number the halves of blocks of the samples (N,); -1 for the first part of an experiment."""
    blocks = np.full(samples.times.size, -1, dtype=np.int64)
    each, count = max(round(_BLOCKS / experiments), 1), 0
    for number in np.unique(samples.experiment):
        own = np.flatnonzero(samples.experiment == number)
        later = own[int(np.ceil(_WARM_UP * own.size)) :]
        for part in np.array_split(later, 2 * each):
            blocks[part] = count
            count += 1
    return blocks


def _average(rows: _Rows) -> _Rows:
    """Average the rows of each step of the grid, apart for each experiment and block."""
    keys = np.stack([rows.experiment, rows.block, np.floor(rows.position).astype(np.int64)])
    begins = np.flatnonzero(np.any(np.diff(keys, axis=1, prepend=-2) != 0, axis=0))
    counts = np.diff(np.append(begins, rows.value.size))
    return _Rows(
        rows.experiment[begins],
        np.add.reduceat(rows.position, begins) / counts,
        np.add.reduceat(rows.value, begins) / counts,
        np.sqrt(counts),
        rows.block[begins],
    )


def _discretise(shapes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Build the matrices (B, n, n) and input vectors (B, n) of chains of sections.

    Shapes (B, n) hold the logarithms of rate and damping for every section of second order, and at
    last that of the rate for one of first order. Every section has gain 1. Rates are per step. The
    state of a section is its value and its slope over the rate, so that slow ones are well scaled.
    """
    count, order = shapes.shape
    matrix = np.zeros((count, order, order))
    at_rest = np.zeros((count, order))
    for k in range(0, order, 2):
        rate = np.exp(shapes[:, k])
        drive = at_rest_index = k
        if k + 1 < order:
            matrix[:, k, k + 1] = rate
            matrix[:, k + 1, k] = -rate
            matrix[:, k + 1, k + 1] = -2.0 * np.exp(shapes[:, k + 1]) * rate
            drive = k + 1
        else:
            matrix[:, k, k] = -rate
        if k:
            matrix[:, drive, k - 2] = rate
        at_rest[:, at_rest_index] = 1.0
    scaled, unit = matrix / 256.0, np.eye(order)
    power = unit + scaled / 5.0
    for divisor in (4.0, 3.0, 2.0, 1.0):
        power = unit + (scaled @ power) / divisor
    for _ in range(8):
        power = power @ power
    return power, at_rest - np.einsum("bij,bj->bi", power, at_rest)


def _compute_impulses(shapes: FloatArray, points: int) -> FloatArray:
    """Compute the impulse responses (B, n, G) of the states, by doubling."""
    power, drive = _discretise(shapes)
    impulses = drive[:, :, None]
    while impulses.shape[2] < points:
        impulses = np.concatenate([impulses, power @ impulses], axis=2)
        power = power @ power
    return impulses[:, :, :points]


class _Signals(NamedTuple):
    """Signals of B shapes on the grid.

    Responses to every input (B, U, n, E · G), free responses (B, n, G), response to a step (B, G).
    """

    responses: FloatArray
    free: FloatArray
    step: FloatArray

    def select(self, number: int) -> "_Signals":
        """Select those of one shape."""
        return _Signals(*(signal[number : number + 1] for signal in self))


def _respond(grid: _Grid, impulses: FloatArray) -> _Signals:
    """Simulate the states of impulse responses (B, n, G) for every input, from rest."""
    count, order, _ = impulses.shape
    responses = _convolve(grid, np.repeat(impulses[:, None], grid.inputs.shape[1], axis=1))
    last = (order - 1) // 2 * 2  # the value of the last section
    return _Signals(
        responses.reshape(count, grid.inputs.shape[1], order, -1),
        impulses / np.maximum(np.max(np.abs(impulses), axis=2, keepdims=True), 1e-300),
        np.cumsum(impulses[:, last], axis=1),
    )


def _convolve(grid: _Grid, impulses: FloatArray) -> FloatArray:
    """Convolve impulse responses (B, U, n, G) with the inputs, (B, U, n, E, G)."""
    transform = rfft(impulses, grid.length, axis=3)[:, :, :, None]
    inputs = grid.spectra.transpose(1, 0, 2)[None, :, None]
    return np.asarray(irfft(transform * inputs, grid.length, axis=4)[..., : grid.points])


class _Places(NamedTuple):
    """Points (R,) of the grid before rows, and the share of the next ones: straight lines."""

    point: IntArray
    share: FloatArray

    def read(self, signals: FloatArray) -> FloatArray:
        """Read signals (…, G) at the places, (…, R)."""
        low = np.take(signals, self.point, axis=-1)
        return np.asarray(low + self.share * self.slope(signals, low))

    def slope(self, signals: FloatArray, low: FloatArray) -> FloatArray:
        """Compute the slopes of signals (…, G) behind the places, (…, R)."""
        return np.asarray(np.take(signals, self.point + 1, axis=-1) - low)


def _locate(position: FloatArray, points: int, offset: IntArray | int = 0) -> _Places:
    index = np.clip(np.floor(position).astype(np.int64), 0, points - 2)
    return _Places(index + offset, np.clip(position - index, 0.0, 1.0))


def _locate_delayed(grid: _Grid, delays: FloatArray, rows: _Rows) -> list[_Places]:
    """Locate rows on the joined grids of the experiments, for each input."""
    offset = rows.experiment * grid.points
    return [_locate(rows.position - delay, grid.points, offset) for delay in delays]


def _read(grid: _Grid, signals: _Signals, delays: FloatArray, rows: _Rows) -> FloatArray:
    """Read the columns (B, P, R) of rows for delays (U,) in steps, times the roots of weights."""
    count, _, order, _ = signals.responses.shape
    driven = [
        places.read(signals.responses[:, u])
        for u, places in enumerate(_locate_delayed(grid, delays, rows))
    ]
    since = _locate(rows.position - grid.first, grid.points)
    free, experiments = since.read(signals.free), grid.inputs.shape[0]
    if experiments > 1:
        is_own = rows.experiment == np.arange(experiments)[:, None]
        free = (free[:, None] * is_own[None, :, None]).reshape(count, experiments * order, -1)
    columns = np.concatenate([*driven, free, since.read(signals.step)[:, None]], axis=1)
    columns *= rows.root
    return np.asarray(columns)


def _make_ridge(columns: FloatArray, channels: int) -> FloatArray:
    """Make the ridge (B, P) of linear coefficients: starts are of the size of the output."""
    count = columns.shape[1]
    ridge = np.asarray(_RIDGE**2 * np.einsum("bpr,bpr->bp", columns, columns) + 1e-200)
    ridge[:, channels : count - 1] += _START_RIDGE**2
    return ridge


def _solve(gram: FloatArray, right: FloatArray) -> FloatArray:
    """Solve symmetric systems (…, P, P) for right sides (…, P), scaled to a unit diagonal."""
    size = np.sqrt(np.maximum(np.einsum("...pp->...p", gram), 1e-300))
    scaled = gram / (size[..., :, None] * size[..., None, :])
    scaled = scaled + 1e-13 * np.eye(gram.shape[-1])
    return np.asarray(np.linalg.solve(scaled, (right / size)[..., None])[..., 0] / size)


class _Expansion(NamedTuple):
    """A fitted shape (n,), its delays (U,) in steps, and what a step from there needs.

    `columns` (R, P) are the slopes over linear coefficients, shape and delays, times the roots of
    the weights; `ridge` (P,) is theirs; `errors` (R,) are weighted too.
    """

    shape: FloatArray
    delays: FloatArray
    squares: float
    columns: FloatArray
    ridge: FloatArray
    errors: FloatArray


def _linearise(grid: _Grid, rows: _Rows, shape: FloatArray, delays: FloatArray) -> _Expansion:
    """Fit the linear coefficients and compute the slopes over all parameters."""
    order, channels = shape.size, delays.size
    moved = np.vstack([shape, shape + _DIFFERENCE * np.eye(order)])
    impulses = _compute_impulses(moved, grid.points)
    signals = _respond(grid, impulses[:1])
    [columns] = _read(grid, signals, delays, rows)
    [ridge] = _make_ridge(columns[None], channels * order)
    gram = columns @ columns.T
    gram[np.diag_indices_from(gram)] += ridge
    value = rows.root * rows.value
    linear = _solve(gram, columns @ value)
    errors = value - linear @ columns
    squares = float(errors @ errors + ridge @ np.square(linear))
    # The perturbed states are summed before they meet the inputs: one convolution for each input.
    change = (impulses[1:] - impulses[0]) / _DIFFERENCE
    driven = linear[: channels * order].reshape(channels, order)
    starts = linear[channels * order : -1].reshape(-1, order)
    starts = starts / np.maximum(np.max(np.abs(impulses[0]), axis=1), 1e-300)
    responses = _convolve(grid, (driven @ change)[:, :, None]).reshape(order, channels, -1)
    last = (order - 1) // 2 * 2
    free = starts @ change + linear[-1] * np.cumsum(change[:, last], axis=1)[:, None]
    since = _locate(rows.position - grid.first, grid.points, rows.experiment * grid.points)
    by_shape, by_delay = since.read(free.reshape(order, -1)), np.empty((channels, value.size))
    for u, places in enumerate(_locate_delayed(grid, delays, rows)):
        by_shape += places.read(responses[:, u])
        summed = driven[u] @ signals.responses[0, u]
        by_delay[u] = -places.slope(summed, summed[places.point])
    whole = np.vstack([columns, rows.root * by_shape, rows.root * by_delay]).T
    tiny = _RIDGE**2 * np.einsum("rp,rp->p", whole[:, linear.size :], whole[:, linear.size :])
    return _Expansion(shape, delays, squares, whole, np.concatenate([ridge, tiny + 1e-200]), errors)


def _clip_shape(grid: _Grid, shape: FloatArray) -> FloatArray:
    """Keep poles stable and slower than the samples, and all but one faster than the record.

    One pole may integrate. With more of them a response to a step is a polynomial in time, which
    follows drifts of coloured noise.
    """
    clipped, slow = shape.copy(), 1.0 / (_SLOW_SHARE * (grid.points - grid.first))
    for k in range(0, shape.size, 2):
        is_last = k + 2 >= shape.size
        slowest = grid.slowest_rate if is_last else slow
        if k + 1 == shape.size:
            clipped[k] = np.clip(shape[k], log(slowest), log(_FASTEST))
            continue
        # The poles are at about `ratio` times the rate, and at the rate over it.
        damping = float(np.clip(exp(shape[k + 1]), *_DAMPING))
        ratio = max(2.0 * damping, 1.0)
        least, most = max(slowest * ratio, slow / ratio), _FASTEST / ratio
        clipped[k] = log(np.clip(exp(shape[k]), least, max(most, least)))
        clipped[k + 1] = log(damping)
    return clipped


def _minimise(grid: _Grid, rows: _Rows, shape: FloatArray, delays: FloatArray) -> _Expansion:
    """Minimise the squares over shape and delays (Levenberg 1944, Marquardt 1963)."""
    fit = _linearise(grid, rows, _clip_shape(grid, shape), delays)
    damping = 1e-2
    for _ in range(_EVALUATIONS):
        gram = fit.columns.T @ fit.columns
        count = shape.size + delays.size
        extra = fit.ridge.copy()
        extra[-count:] += damping * gram.diagonal()[-count:]
        gram[np.diag_indices_from(gram)] += extra
        move = np.clip(_solve(gram, fit.columns.T @ fit.errors)[-count:], -3.0, 3.0)
        trial = _linearise(grid, rows, *_move(grid, fit, move))
        if trial.squares < fit.squares:
            is_done = trial.squares > (1.0 - _CONVERGED) * fit.squares
            fit, damping = trial, 0.1 * damping
            if is_done:
                break
        else:
            damping *= 10.0
            if damping > 1e3:
                break
    return fit


def _move(grid: _Grid, fit: _Expansion, move: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Move shape and delays, within their bounds; logarithms move by 1 at most."""
    shape = _clip_shape(grid, fit.shape + np.clip(move[: fit.shape.size], -1.0, 1.0))
    delays = np.clip(fit.delays + move[fit.shape.size :], -1.0, float(grid.longest_delay))
    return shape, delays


class _Peak(NamedTuple):
    """Best shape (n,) of a scan for one input, its delay in steps, and the squares it explains."""

    shape: FloatArray
    delay: int
    explained: float
    response: FloatArray


def _list_rates(grid: _Grid) -> FloatArray:
    """List the rates of a scan, per step: from the whole record to a step."""
    count = int(np.ceil(_SHAPES_PER_DECADE * np.log10(grid.points))) + 1
    return np.geomspace(1.0 / grid.points, 1.0, count)


def _spread(grid: _Grid, rows: _Rows, values: FloatArray) -> FloatArray:
    """Add weighted values (R,) up on the grid, (E, G)."""
    experiments, _, points = grid.inputs.shape
    place = np.rint(rows.position).astype(np.int64) + rows.experiment * points
    total = np.bincount(place, rows.root**2 * values, experiments * points)
    return np.asarray(total.reshape(experiments, points))


def _scan(grid: _Grid, channel: int, target: FloatArray, shapes: FloatArray) -> _Peak:
    """Find the shape (of S, n) and the delay that explain a target (E, G) best, n = 1 or 2."""
    transform = rfft(_compute_impulses(shapes, grid.points), grid.length, axis=2)
    spectra = transform[:, :, None, :] * grid.spectra[None, None, :, channel]
    responses = irfft(spectra, grid.length, axis=3)[..., : grid.points]
    crossed = np.sum(np.conj(spectra) * rfft(target, grid.length, axis=1), axis=2)
    count = grid.longest_delay + 1
    sums = irfft(crossed, grid.length, axis=2)[..., :count]
    ends = grid.points - 1 - np.arange(count)
    means = np.cumsum(responses.sum(axis=2), axis=2)[..., ends]
    pairs = np.einsum("saeg,sbeg->sabg", responses, responses)
    grams = np.cumsum(pairs, axis=3)[..., ends]
    total = grid.points * grid.inputs.shape[0]
    grams = grams - means[:, :, None] * means[:, None] / total
    grams = np.moveaxis(grams, 3, 1) + 1e-9 * total * np.eye(shapes.shape[1])
    sums = np.moveaxis(sums, 2, 1)
    if shapes.shape[1] == 1:
        coefficients = sums / grams[..., 0]
    else:
        determinant = grams[..., 0, 0] * grams[..., 1, 1] - grams[..., 0, 1] ** 2
        first = grams[..., 1, 1] * sums[..., 0] - grams[..., 0, 1] * sums[..., 1]
        second = grams[..., 0, 0] * sums[..., 1] - grams[..., 0, 1] * sums[..., 0]
        coefficients = np.stack([first, second], axis=2) / determinant[..., None]
    explained = np.sum(coefficients * sums, axis=2)
    s, delay = np.unravel_index(int(np.argmax(explained)), explained.shape)
    response = np.zeros_like(target)
    summed = np.einsum("a,aeg->eg", coefficients[s, delay], responses[s])
    response[:, delay:] = summed[:, : grid.points - delay]
    return _Peak(shapes[s], int(delay), float(explained[s, delay]), response)


def _scan_inputs(grid: _Grid, rows: _Rows, shapes: FloatArray) -> list[_Peak]:
    """Scan the inputs one after the other, each for what the others leave (backfitting)."""
    weight = _spread(grid, rows, np.ones(rows.value.size))
    target = _spread(grid, rows, rows.value)
    target -= weight * (np.sum(target) / np.sum(weight))
    channels = grid.inputs.shape[1]
    peaks: dict[int, _Peak] = {}
    for _ in range(1 if channels == 1 else 2):
        for channel in range(channels):
            left = target - sum(
                weight * (peak.response - np.mean(peak.response))
                for other, peak in peaks.items()
                if other != channel
            )
            peaks[channel] = _scan(grid, channel, left, shapes)
    return [peaks[channel] for channel in range(channels)]


def _choose_stride(grid: _Grid, rows: _Rows) -> int:
    """Choose how many samples are averaged: as many as slow dynamics and a long record allow."""
    most = rows.value.size // _ROWS
    if most < 2:
        return 1
    rates = np.geomspace(1.0 / grid.points, 1.0, 8)
    peaks = _scan_inputs(grid, rows, np.log(rates)[:, None])
    fastest = max(exp(peak.shape[0]) for peak in peaks)
    return int(np.clip(1.0 / (_STEPS_PER_TIME_CONSTANT * fastest), 1, most))


def _fit_orders(grid: _Grid, rows: _Rows) -> list[_Expansion]:
    """Fit each order; list those that simulate left-out blocks better than all lower ones."""
    better, least = list[_Expansion](), np.full((int(np.max(rows.block)) + 1) // 2, np.inf)
    for fit in _fit_each_order(grid, rows):
        squares = _sum_left_out(fit, rows)
        known = np.isfinite(squares) & ~np.isnan(least)
        if np.mean(known) < _LEAST_SHARE:
            continue
        if np.sum(squares[known]) < _WORTHWHILE * np.sum(least[known]):
            least = squares
            better.append(fit)
    return better


def _fit_each_order(grid: _Grid, rows: _Rows) -> Iterator[_Expansion]:
    """Fit one order after the other, as far as there are rows enough."""
    rates = np.log(_list_rates(grid))
    real = _scan_inputs(grid, rows, rates[:, None])
    pairs = [(rate, log(damping)) for rate in rates for damping in _SCANNED_DAMPING]
    resonant = _scan_inputs(grid, rows, np.array(pairs))
    fit: _Expansion | None = None
    for order in ORDERS:
        parameters = (order + 1) * sum(grid.inputs.shape[:2]) + order
        if _ROWS_PER_PARAMETER * parameters > rows.value.size:
            return
        starts = _list_starts(grid, order, real, resonant, fit)
        lower, fit = fit, _minimise(grid, rows, *_select_start(grid, rows, starts))
        yield fit
        is_settled = lower is not None and fit.squares > _WORTHWHILE * lower.squares
        if is_settled and order > 2:  # a resonance may need two poles at once
            return


_Start = tuple[FloatArray, FloatArray]


def _list_starts(
    grid: _Grid,
    order: int,
    real: Sequence[_Peak],
    resonant: Sequence[_Peak],
    previous: _Expansion | None,
) -> list[_Start]:
    """List starting shapes (S, n) with their delays: peaks, and one order less with a new pole."""
    peaks = real if previous is None else resonant
    delays = np.array([float(peak.delay) for peak in peaks])
    shapes = np.array([peak.shape for peak in peaks])
    if previous is None:
        return [(shapes, delays)]
    starts = list[_Start]()
    if order % 2 == 0:
        starts.append((np.hstack([_repeat(previous.shape[:-1], delays), shapes]), delays))
    rates = np.log(np.geomspace(2.0 / grid.points, 1.0, _NEW_POLES))
    pairs, last = previous.shape[:-1], previous.shape[-1]
    if order % 2 and last > 0:  # two real poles: the slow one may integrate, so it comes last
        spread = np.arccosh(np.exp(last))
        shapes = np.hstack([_pair(rates, pairs[-1] + spread), _repeat(pairs[-1] - spread, rates)])
    elif order % 2:
        shapes = np.hstack([_repeat(previous.shape, rates), rates[:, None]])
    else:
        shapes = np.hstack([_repeat(pairs, rates), _pair(rates, last)])
    starts += [(shapes, share * previous.delays) for share in _SCANNED_DELAYS]
    return starts


def _pair(rates: FloatArray, other: float) -> FloatArray:
    """Return sections (S, 2) with the poles of each of S rates and another, all logarithms."""
    return np.column_stack([0.5 * (rates + other), np.log(np.cosh(0.5 * (rates - other)))])


def _repeat(values: FloatArray, rates: FloatArray) -> FloatArray:
    return np.tile(values, (rates.size, 1))


def _select_start(grid: _Grid, rows: _Rows, starts: Sequence[_Start]) -> _Start:
    """Select the start with the least squares, after a fit of the linear part to some rows."""
    some = _take(rows, slice(None, None, max(rows.value.size // _START_ROWS, 1)))
    value, best = some.root * some.value, (-np.inf, starts[0])
    signals, known = None, np.empty(0)
    for shapes, delays in starts:
        if signals is None or shapes is not known:
            known = shapes
            clipped = np.array([_clip_shape(grid, shape) for shape in shapes])
            signals = _respond(grid, _compute_impulses(clipped, grid.points))
        columns = _read(grid, signals, delays, some)
        gram = columns @ columns.transpose(0, 2, 1)
        diagonal = np.arange(gram.shape[1])
        gram[:, diagonal, diagonal] += _make_ridge(columns, shapes.shape[1] * delays.size)
        right = columns @ value
        explained = np.einsum("bp,bp->b", right, _solve(gram, right))
        most = int(np.argmax(explained))
        if explained[most] > best[0]:
            best = (float(explained[most]), (shapes[most], delays))
    return best[1]


class _Omission(NamedTuple):
    """A block left out of the rows (R,): which are in it, and which the fit without it sees.

    `move` (P,) is that of all parameters. `is_told`: the rows that are seen determine what is
    simulated in the block.
    """

    mask: BoolArray
    seen: BoolArray
    move: FloatArray
    is_told: bool


def _hide(rows: _Rows) -> list[tuple[BoolArray, BoolArray]]:
    """List the rows in each block, and those that are seen without it.

    Half a block at either side is not seen, because coloured noise there knows the noise in the
    block (h-block cross-validation: Burman, Chow and Nolan, Biometrika 81 (1994) 351).
    """
    parts = []
    for first in range(0, int(np.max(rows.block)) + 1, 2):
        mask = (rows.block == first) | (rows.block == first + 1)
        is_near = (rows.block >= max(first - 1, 0)) & (rows.block <= first + 2)
        is_near &= np.isin(rows.experiment, rows.experiment[mask])
        parts.append((mask, ~(mask | is_near)))
    return parts


def _leave_out(fit: _Expansion, rows: _Rows) -> list[_Omission]:
    """Leave out each block by a Gauss–Newton step.

    The mean variance of what is then simulated, over that of the noise, is the mean diagonal of
    J A⁻¹ Jᵀ, where A is the sum of products of the rows that are seen. Up to 1 the block is told.
    """
    parts = _hide(rows)
    gram = fit.columns.T @ fit.columns
    gram[np.diag_indices_from(gram)] += fit.ridge
    others = np.array([gram - fit.columns[~seen].T @ fit.columns[~seen] for _, seen in parts])
    right = np.array([fit.columns[~seen].T @ fit.errors[~seen] for _, seen in parts])
    size = np.sqrt(np.maximum(np.einsum("bpp->bp", others), 1e-300))
    scaled = others / (size[:, :, None] * size[:, None, :])
    inverse = np.linalg.pinv(scaled, rcond=1e-13, hermitian=True)
    moves = -np.einsum("bpq,bq->bp", inverse, right / size) / size
    left_out = []
    for i, (mask, seen) in enumerate(parts):
        inside = fit.columns[mask] / size[i]
        variance = float(np.sum((inside @ inverse[i]) * inside))
        is_told = variance <= float(np.count_nonzero(mask))
        left_out.append(_Omission(mask, seen, moves[i], is_told))
    return left_out


def _sum_left_out(fit: _Expansion, rows: _Rows) -> FloatArray:
    """Sum the squared errors of each left-out block (B,), linear in all parameters.

    It is nan for a block that the others do not tell.
    """
    return np.array(
        [
            float(np.sum(np.square(fit.errors[mask] - fit.columns[mask] @ move)))
            if is_told
            else np.nan
            for mask, _, move, is_told in _leave_out(fit, rows)
        ]
    )


def _simulate_left_out(grid: _Grid, rows: _Rows, fit: _Expansion, every: _Rows) -> FloatArray:
    """Simulate each block of all samples with parameters fitted without it; nan elsewhere."""
    predicted = np.full(every.value.size, np.nan)
    left_out = _leave_out(fit, rows)
    waiting = [number for number, block in enumerate(left_out) if block.is_told]
    count = fit.shape.size + fit.delays.size
    for share in _STEP_SHARES:
        moved = [_move(grid, fit, share * left_out[number].move[-count:]) for number in waiting]
        if not moved:
            break
        shapes = np.array([shape for shape, _ in moved])
        signals = _respond(grid, _compute_impulses(shapes, grid.points))
        rejected = []
        for i, number in enumerate(waiting):
            seen, delays = left_out[number].seen, moved[i][1]
            linear, squares = _fit_linear(grid, signals.select(i), delays, _take(rows, seen))
            before = float(np.sum(np.square(fit.errors[seen])))
            if squares > before and share != _STEP_SHARES[-1]:
                rejected.append(number)
                continue
            own = every.block // 2 == number
            columns = _read_plain(grid, signals.select(i), delays, _take(every, own))
            predicted[own] = linear @ columns
        waiting = rejected
    return predicted


def _read_plain(grid: _Grid, signals: _Signals, delays: FloatArray, samples: _Rows) -> FloatArray:
    """Read the columns (P, N) of one shape for samples, without weights."""
    plain = samples._replace(root=np.ones(samples.value.size))
    return np.asarray(_read(grid, signals, delays, plain)[0])


def _take(rows: _Rows, chosen: BoolArray | slice) -> _Rows:
    return _Rows._make(column[chosen] for column in rows)


def _fit_linear(
    grid: _Grid, signals: _Signals, delays: FloatArray, rows: _Rows
) -> tuple[FloatArray, float]:
    """Fit the linear coefficients (P,) to rows; return their squares too."""
    [columns] = _read(grid, signals, delays, rows)
    value = rows.root * rows.value
    gram = columns @ columns.T
    size = signals.responses.shape[1] * signals.responses.shape[2]
    gram[np.diag_indices_from(gram)] += _make_ridge(columns[None], size)[0]
    linear = _solve(gram, columns @ value)
    return linear, float(np.sum(np.square(value - linear @ columns)))
