"""A yardstick: a linear black box, fitted in milliseconds and compared with the user's model.

For every output, linear models of order 1 to 4 with a time lag for each input are fitted by their
simulation error (output error, Ljung 1999, ch. 10). So noise at the output, however coloured, makes
no bias. The inputs share the poles. The order is the one whose left-out blocks are simulated best.

The user's model is compared on the same samples, but it was fitted to them too. So it is at an
advantage, and what is said against it is safe. Time lags, shapes and orders were chosen with all
blocks, and the best of many choices fits even noise. So the logarithm of their number is subtracted
from the gain (Bonferroni).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.fft import rfft

from sysid.core.types import FloatArray, IntArray
from sysid.data.interpolation import interpolate_channel
from sysid.data.records import Record
from sysid.judgement.input_grid import GridRows, InputGrid, average_rows, make_input_grid
from sysid.judgement.left_out_blocks import LEAST_SHARE, fit_better_orders, simulate_left_out
from sysid.judgement.linear_fits import choose_stride, count_choices
from sysid.residuals.autocorrelation import ROUNDING_SHARE, space_residuals
from sysid.simulation.fit_metrics import EXPLAINED_PERCENT, rms
from sysid.simulation.problem import Problem

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
_MIN_SAMPLES = 40
_MOST_POINTS = 50_000  # of the grids of all inputs: a longer record is averaged


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


def fit_reverse(
    problem: Problem, simulated: FloatArray, cause: str, effect: str
) -> Yardstick | None:
    """Fit linear models to an input with an output as their input, and compare as fits in %.

    The user's model counts as if it left the same share of the input as it leaves of the output.

    Parameters
    ----------
    simulated : FloatArray, shape (M,)
        Values that the user's model simulates at the measured times.
    cause, effect : str
        Input and output of the model.
    """
    samples = _read_outputs(problem, simulated, effect)
    if samples is None:
        return None
    measured, records = np.zeros(samples.times.size), list[Record]()
    for number, record in enumerate(problem.records):
        [given] = [one for one in record.inputs if one.name == cause]
        [answer] = [one for one in record.outputs if one.name == effect]
        own = samples.experiment == number
        measured[own] = interpolate_channel(replace(given, hold="first"), samples.times[own])
        known = np.isfinite(answer.values)
        driver = replace(
            answer, times=answer.times[known], values=answer.values[known], hold="first"
        )
        records.append(replace(record, inputs=(driver,)))
    spread = float(np.std(measured))
    if spread <= ROUNDING_SHARE * float(np.max(np.abs(measured))):
        return None
    left = (samples.measured - samples.simulated) * spread / float(np.std(samples.measured))
    return _compare(
        records, samples._replace(output=cause, measured=measured, simulated=measured - left)
    )


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


def _compare(records: Sequence[Record], samples: _Samples) -> Yardstick | None:
    """Fit linear models to one output and compare; None if too little can be compared."""
    moving = _list_moving_inputs(records)
    if not moving:
        return None
    period, spans = _measure_period(samples, len(records))
    points = float(np.max(spans)) / period * len(records) * len(moving)
    stride = max(int(np.ceil(points / _MOST_POINTS)), 1)
    placed = _place(records, moving, samples, period, stride)
    slower = choose_stride(placed.grid, placed.rows)
    if slower > 1:
        placed = _place(records, moving, samples, period, slower * stride)
    grid, rows, every = placed
    best, least = None, np.inf
    for fit in reversed(fit_better_orders(grid, rows)):
        simulated = simulate_left_out(grid, rows, fit, every)
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
    return replace(yardstick, gain=yardstick.gain - count_choices(grid))


def _compute_mean_square(simulated: FloatArray, every: GridRows) -> float:
    """Compute the mean square error of left-out blocks; infinite if most are not told."""
    told = np.isfinite(simulated)
    if np.mean(told) < LEAST_SHARE:
        return float(np.inf)
    return float(np.mean(np.square(every.value[told] - simulated[told])))


class _Placed(NamedTuple):
    """Samples on a grid: the rows of a fit, which may be averages, and every sample."""

    grid: InputGrid
    rows: GridRows
    every: GridRows


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
    longest = max(
        np.ptp(samples.times[samples.experiment == e]) for e in np.unique(samples.experiment)
    )
    grid = make_input_grid(records, moving, starts, float(longest), stride * period)
    every = GridRows(
        samples.experiment,
        (samples.times - starts[samples.experiment]) / grid.step + grid.first,
        (samples.measured - np.mean(samples.measured)) / np.std(samples.measured),
        np.ones(samples.times.size),
        _split_blocks(samples, len(records)),
    )
    return _Placed(grid, every if stride == 1 else average_rows(every), every)


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


def _assess(
    samples: _Samples, simulated: FloatArray, order: int, delays: Mapping[str, float]
) -> Yardstick | None:
    """Compare both models on left-out samples; None if most are not told, or do not move.

    `simulated` (N,) is centred and of unit size, as the rows are, and nan where it is not told.
    """
    is_compared = np.isfinite(simulated)
    if np.mean(is_compared) < LEAST_SHARE:
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
