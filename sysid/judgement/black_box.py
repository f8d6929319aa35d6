"""A linear black box: sections found one after the other, and simulated on left-out blocks.

A linear model is a sum of sections. Each has a real pole or a pair, an input and a time lag. They
are found one after the other, each at the best place for what the others leave, and then all are
moved together (orthogonal matching pursuit with Newton steps: Mamandipoor, Ramasamy and Madhow,
IEEE Trans. Signal Process. 64 (2016) 5066). What is fitted is the simulation error (output error,
Ljung 1999, ch. 10). So noise at the output, however coloured, makes no bias. Numerators, starts and
offsets enter linearly (Golub and Pereyra 1973).

The number of sections is the least whose left-out blocks are simulated as well as by the best one,
but for a standard error (Breiman et al., Classification and Regression Trees, 1984). Blocks are
left out by linear algebra, as in Allen's PRESS (Technometrics 16 (1974) 125), with half a block at
either side, because coloured noise there knows the noise in the block (Burman, Chow and Nolan,
Biometrika 81 (1994) 351).
"""

import cmath
from collections.abc import Sequence
from itertools import combinations_with_replacement
from math import ceil, exp, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.fft import irfft, rfft

from sysid.core.types import ComplexArray, FloatArray, IntArray
from sysid.data.records import Channel
from sysid.judgement.decaying_sums import sum_with_decay
from sysid.residuals.autocorrelation import ROUNDING_SHARE, pad_length

_MOST_POLES = 4  # for each input
_LEAST_SHARE = 0.5  # of the samples must be told
_ROWS_PER_PARAMETER = 5  # at least
"""Measured with `benchmarks.judgement`, a record of each of 102 kinds: 3 to 10, with a
`_MOST_DAMPING` of 0.9 to 0.995, give the same verdicts. One tells 96 % instead of 97 %."""
_MOST_POINTS = 20_000  # of a grid: a longer record is averaged
_LONGEST_DELAY = 1.0 / 3.0  # of the record
_SLOW = 3.0  # over the record: only one section may have a slower pole
_SLOWEST = 0.01  # over the record: an integrator
_FASTEST = 3.0  # per step: a faster pole is a static gain
_SPACING = 0.6  # of the logarithm of a rate
_DAMPING = (0.1, 0.5)
_MOST_DAMPING = 0.98  # of a pair: beyond it, two real poles do as well
_STEPS = 8  # of Gauss–Newton, for each new section
_CONVERGED = 1e-3  # relative decrease of the squares
_DIFFERENCE = 1e-3  # of a step or a logarithm, for slopes by differences
_MOST_MOVE = (3.0, 1.0, 1.0)  # of a delay in steps, and of logarithms
_RIDGE = 1e-9  # of the square of a column, against rounding
"""Measured with `benchmarks.judgement`, a record of each of 102 kinds: `_MOST_POLES` of 3 or 6,
`_LEAST_SHARE` of 0.3 or 0.7 and `_SPACING` of 0.9 or 0.4 leave all statuses."""


class Samples(NamedTuple):
    """Samples (N,) of an output: experiment, time (s) and value.

    `block` numbers the halves of blocks, from 0; it is -1 for a sample that is never left out.
    """

    experiment: IntArray
    times: FloatArray
    values: FloatArray
    block: IntArray


class LeftOut(NamedTuple):
    """Values (N,) that a linear model of an order simulates in blocks left out of its fit.

    They are nan where the other blocks do not tell them. `choices` is the logarithm of the number
    of orders times that of shapes and time lags that were tried for each input.
    """

    values: FloatArray
    order: int
    choices: float


def simulate_left_out(inputs: Sequence[Sequence[Channel]], samples: Samples) -> LeftOut | None:
    """Fit linear models of inputs (U, E) and simulate left-out blocks by the best of them.

    Returns
    -------
    LeftOut or None
        None if no input moves, or no model is told by half of the samples.
    """
    grid, every = _place(inputs, samples)
    if not grid.inputs.size:
        return None
    rows, sections = _average_rows(every), list[_Section]()
    shapes = _list_shapes(grid, rows)
    found, told = list[LeftOut](), np.ones(every.value.size, dtype=np.bool_)
    while (added := _find_section(grid, rows, sections, shapes)) is not None:
        fit = _refine(grid, rows, [*sections, added])
        sections = fit.sections
        values = _leave_out(grid, fit, rows, every)
        if np.mean(told & np.isfinite(values)) >= _LEAST_SHARE:
            told &= np.isfinite(values)
            found.append(LeftOut(values, sum(one.order for one in sections), 0.0))
    if not found:
        return None
    blocks = every.block[told] // 2
    squares = [np.bincount(blocks, np.square(one.values - every.value)[told]) for one in found]
    excess = np.array(squares) - min(squares, key=np.sum)
    error = sqrt(excess.shape[1]) * np.std(excess, axis=1)
    best = found[int(np.argmax(np.sum(excess, axis=1) <= error))]
    values = np.where(told, best.values + np.mean(samples.values), np.nan)
    channels = len(grid.inputs)
    each = (grid.longest_delay + 1) * len(shapes) / channels
    return LeftOut(values, best.order, log(len(found)) + channels * log(each))


class _Rows(NamedTuple):
    """Rows (R,) of a fit: experiment, position on the grid, centred value, weight and block."""

    experiment: IntArray
    position: FloatArray
    value: FloatArray
    weight: FloatArray
    block: IntArray


class _Grid(NamedTuple):
    """Inputs (U, G, E) on a regular grid, and their transforms (U, F, E) of a length.

    They are means over the step before a point, from the first value of their experiment. The
    samples begin at point `first`.
    """

    inputs: FloatArray
    spectra: ComplexArray
    length: int
    first: int

    @property
    def points(self) -> int:
        """G: points of the grid."""
        return int(self.inputs.shape[1])

    @property
    def experiments(self) -> int:
        """E: experiments."""
        return int(self.inputs.shape[2])

    @property
    def longest_delay(self) -> int:
        """Longest time lag that is tried, in steps."""
        return max(int(_LONGEST_DELAY * (self.points - self.first)), 1)

    @property
    def slow(self) -> float:
        """Logarithm of the rate per step below which only one section may be."""
        return log(_SLOW / (self.points - self.first))


def _place(inputs: Sequence[Sequence[Channel]], samples: Samples) -> tuple[_Grid, _Rows]:
    """Place inputs that move, and samples, on a grid of the sampling period or a multiple.

    The period is the median distance, or longer if most samples are missing.
    """
    each = [samples.times[samples.experiment == number] for number in range(len(inputs[0]))]
    starts = np.array([times[0] if times.size else 0.0 for times in each])
    spans = np.array([np.ptp(times) if times.size else 0.0 for times in each])
    steps = np.concatenate([np.diff(times) for times in each])
    period = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 1.0
    step = max(period, float(np.sum(spans)) / (2 * samples.times.size))
    step *= max(ceil(np.max(spans) / step * starts.size / _MOST_POINTS), 1)
    points = ceil(np.max(spans) / step) + 3
    known = [[one.history_and_samples.times[0] for one in channels] for channels in inputs]
    before = float(np.max(starts - known)) / step
    first = int(np.clip(before, 0.0, _LONGEST_DELAY * points))
    edges = starts[:, None] + step * (np.arange(first + points + 1.0) - first - 1.0)
    means = np.array(
        [np.transpose(list(map(average_input, channels, edges))) for channels in inputs]
    )
    moves = means - means[:, :1]
    size = ROUNDING_SHARE * np.max(np.abs(means), axis=(1, 2))
    moves = moves[np.max(np.abs(moves), axis=(1, 2)) > size]
    length = pad_length(2 * (first + points))
    position = (samples.times - starts[samples.experiment]) / step + first
    value = samples.values - np.mean(samples.values)
    rows = _Rows(samples.experiment, position, value, np.ones(value.size), samples.block)
    return _Grid(moves, rfft(moves, length, axis=1), length, first), rows


def average_input(channel: Channel, edges: FloatArray) -> FloatArray:
    """Average an input between the edges (G + 1,); its ends are held outside the record."""
    channel = channel.acting
    whole = channel.history_and_samples
    known = np.isfinite(whole.values)
    times, values = whole.times[known], whole.values[known]
    knots = np.union1d(times, edges)
    if channel.effective_hold == "zero":
        heights = values[np.maximum(np.searchsorted(times, knots[:-1], side="right") - 1, 0)]
    else:
        heights = np.interp(knots, times, values)
        heights = 0.5 * (heights[1:] + heights[:-1])
    integral = np.concatenate([[0.0], np.cumsum(heights * np.diff(knots))])
    return np.asarray(np.diff(integral[np.searchsorted(knots, edges)]) / np.diff(edges))


def _average_rows(rows: _Rows) -> _Rows:
    """Average the rows of each step of the grid, apart for each experiment and block."""
    keys = np.stack([rows.experiment, rows.block, np.rint(rows.position).astype(np.int64)])
    begins = np.flatnonzero(np.any(np.diff(keys, axis=1, prepend=-2) != 0, axis=0))
    counts = np.diff(np.append(begins, rows.value.size)).astype(np.float64)
    return _Rows(
        rows.experiment[begins],
        np.add.reduceat(rows.position, begins) / counts,
        np.add.reduceat(rows.value, begins) / counts,
        counts,
        rows.block[begins],
    )


class _Section(NamedTuple):
    """A pole or a pair that an input drives.

    `place` is its delay in steps, the logarithm of its rate per step and, for a pair, that of its
    damping.
    """

    channel: int
    place: FloatArray

    @property
    def order(self) -> int:
        """Number of poles."""
        return self.place.size - 1

    @property
    def decay(self) -> complex:
        """Factor of its states per step."""
        rate = exp(self.place[1])
        if self.order == 1:
            return complex(exp(-rate))
        damping = exp(self.place[2])
        return cmath.exp(rate * complex(-damping, sqrt(1.0 - damping**2)))

    def answer(self, since: FloatArray) -> FloatArray:
        """Compute impulse responses (n, …) of its n states after so many steps; 0 before."""
        after = np.exp(self.place[1]) * np.maximum(since, 0.0)
        if self.order == 1:
            return np.asarray(np.exp(-after)[None])
        damping = np.exp(self.place[2])
        angle = np.sqrt(1.0 - damping**2) * after
        waves = np.stack([np.cos(angle), np.sin(angle)])
        return np.asarray(np.exp(-damping * after) * waves)

    def simulate(self, grid: _Grid) -> FloatArray:
        """Simulate its states on the grid, (n, G, E), from rest and without delay."""
        return sum_with_decay(grid.inputs[self.channel], self.decay)

    def read(self, grid: _Grid, rows: _Rows) -> FloatArray:
        """Read its columns (n + n E, R): responses, and those to the start of each experiment."""
        position = rows.position - self.place[0]
        low = np.clip(np.floor(position).astype(np.int64), 0, grid.points - 2)
        share = np.clip(position - low, 0.0, 1.0)
        states = self.simulate(grid)
        before, after = states[:, low, rows.experiment], states[:, low + 1, rows.experiment]
        free = self.answer(rows.position - grid.first)[:, None] * _tell_apart(grid, rows)
        return np.vstack([before + share * (after - before), free.reshape(-1, position.size)])

    def move(self, grid: _Grid, move: FloatArray) -> "_Section":
        """Move it within its bounds, by 3 steps and a factor e at most."""
        limit, damped = np.array(_MOST_MOVE[: move.size]), log(_MOST_DAMPING)
        place = self.place + np.clip(move, -limit, limit)
        slowest = grid.slow if self.place[1] >= grid.slow else log(_SLOWEST / grid.points)
        place[0] = np.clip(place[0], 0.0, grid.longest_delay)
        place[1] = np.clip(place[1], slowest, log(_FASTEST))
        place[2:] = np.clip(place[2:], min(grid.slow - place[1], damped), damped)
        return self._replace(place=place)


def _tell_apart(grid: _Grid, rows: _Rows) -> FloatArray:
    """Build the columns (E, R) that are 1 in an experiment."""
    return np.equal.outer(np.arange(grid.experiments), rows.experiment).astype(np.float64)


class _FittedSections(NamedTuple):
    """Sections with their columns (R, P), linear coefficients (P,) and weighted errors (R,)."""

    sections: list[_Section]
    columns: FloatArray
    linear: FloatArray
    errors: FloatArray

    @property
    def squares(self) -> float:
        return float(self.errors @ self.errors)


def _read_columns(grid: _Grid, sections: Sequence[_Section], rows: _Rows) -> FloatArray:
    """Read the columns (R, P): an offset for each experiment, and those of the sections."""
    return np.vstack([_tell_apart(grid, rows), *(one.read(grid, rows) for one in sections)]).T


def _fit_linear(grid: _Grid, rows: _Rows, sections: list[_Section]) -> _FittedSections:
    """Fit all that is linear."""
    columns, root = _read_columns(grid, sections, rows), np.sqrt(rows.weight)
    weighted = root[:, None] * columns
    linear = _invert(weighted.T @ weighted) @ (weighted.T @ (root * rows.value))
    return _FittedSections(sections, columns, linear, root * (rows.value - columns @ linear))


def _invert(gram: FloatArray) -> FloatArray:
    """Invert a matrix of products (P, P) of columns."""
    size = np.sqrt(np.maximum(gram.diagonal(), 1e-200))
    scaled = gram / np.outer(size, size) + _RIDGE * np.eye(size.size)
    return np.asarray(np.linalg.inv(scaled) / np.outer(size, size))


def _add_slopes(grid: _Grid, fit: _FittedSections, rows: _Rows, columns: FloatArray) -> FloatArray:
    """Add to the columns (R, P) of a fit its slopes over the places of all sections."""
    slopes, begin = [], grid.experiments
    for one in fit.sections:
        own = slice(begin, begin + one.order * (1 + grid.experiments))
        for change in _DIFFERENCE * np.eye(one.place.size):
            moved = one._replace(place=one.place + change).read(grid, rows)
            slopes.append((fit.linear[own] @ (moved - columns.T[own])) / _DIFFERENCE)
        begin = own.stop
    return np.column_stack([columns, *slopes])


def _refine(grid: _Grid, rows: _Rows, sections: list[_Section]) -> _FittedSections:
    """Move the sections by Gauss–Newton steps, damped (Levenberg 1944, Marquardt 1963)."""
    fit, damping = _fit_linear(grid, rows, sections), 1e-2
    ends = np.cumsum([one.place.size for one in sections])
    for _ in range(_STEPS):
        columns = np.sqrt(rows.weight)[:, None] * _add_slopes(grid, fit, rows, fit.columns)
        gram, count = columns.T @ columns, fit.linear.size
        gram[count:, count:] += damping * np.diag(gram.diagonal()[count:])
        steps = np.split((_invert(gram) @ (columns.T @ fit.errors))[count:], ends[:-1])
        moved = [one.move(grid, step) for one, step in zip(fit.sections, steps, strict=True)]
        trial = _fit_linear(grid, rows, moved)
        if trial.squares >= fit.squares:
            damping *= 10.0
            continue
        is_settled = trial.squares > (1.0 - _CONVERGED) * fit.squares
        fit, damping = trial, 0.1 * damping
        if is_settled:
            break
    return fit


def _leave_out(grid: _Grid, fit: _FittedSections, rows: _Rows, every: _Rows) -> FloatArray:
    """Simulate each block of all samples, linearly in all parameters; nan elsewhere.

    The mean variance of what is simulated, over that of the noise, is the mean diagonal of
    X A⁻¹ Xᵀ, where A is the sum of products of the rows that are seen. Up to 1 the block is told.
    """
    columns = _add_slopes(grid, fit, rows, fit.columns)
    inside = _add_slopes(grid, fit, every, _read_columns(grid, fit.sections, every))
    simulated = np.full(every.value.size, np.nan)
    changes = np.any(np.diff([rows.experiment, rows.block], axis=1) != 0, axis=0)
    parts = np.split(np.arange(rows.value.size), np.flatnonzero(changes) + 1)
    begins = [part[0] for part in parts]
    experiments, blocks = rows.experiment[begins], rows.block[begins]
    weighted = rows.weight[:, None] * columns
    grams = np.array([columns[part].T @ weighted[part] for part in parts])
    rights = np.array([weighted[part].T @ rows.value[part] for part in parts])
    for first in range(0, int(np.max(rows.block)) + 1, 2):
        own = every.block // 2 == first // 2
        is_near = (blocks >= max(first - 1, 0)) & (blocks <= first + 2)
        seen = ~(is_near & (experiments == every.experiment[own][0]))
        inverse = _invert(np.sum(grams[seen], axis=0))
        if np.sum((inside[own] @ inverse) * inside[own]) <= np.count_nonzero(own):
            simulated[own] = inside[own] @ (inverse @ np.sum(rights[seen], axis=0))
    return simulated


class _Shape(NamedTuple):
    """A section that is tried at all delays, and products (D, n, n) of its n delayed states."""

    section: _Section
    products: FloatArray


def _list_shapes(grid: _Grid, rows: _Rows) -> list[_Shape]:
    """List the sections that are tried at all delays."""
    shapes = [[log(_SLOWEST / grid.points)]]
    shapes += [[rate] for rate in np.arange(grid.slow, log(_FASTEST), _SPACING)]
    for damping in _DAMPING:
        rates = np.arange(grid.slow - log(damping), log(_FASTEST), min(2.5 * damping, _SPACING))
        shapes += [[rate, log(damping)] for rate in rates]
    channels = range(grid.inputs.shape[0])
    sections = [
        _Section(channel, np.array([0.0, *shape])) for channel in channels for shape in shapes
    ]
    [weights] = _spread(grid, rows, rows.weight[None])
    transform = rfft(weights, grid.length, axis=0)
    return [_Shape(one, _multiply_delayed(grid, one, transform)) for one in sections]


def _spread(grid: _Grid, rows: _Rows, values: FloatArray) -> FloatArray:
    """Sum values (m, R) of the rows at the points of the grid, (m, G, E)."""
    place = np.rint(rows.position).astype(np.int64) * grid.experiments + rows.experiment
    size = grid.points * grid.experiments
    summed = [np.bincount(place, one, size) for one in values]
    return np.reshape(summed, (-1, grid.points, grid.experiments))


def _correlate(grid: _Grid, signals: ComplexArray, others: ComplexArray, lags: int) -> FloatArray:
    """Correlate signals with others (…, F, E) that are later by up to so many steps, (…, lags)."""
    crossed = np.sum(np.conj(signals) * others, axis=-1)
    return np.asarray(irfft(crossed, grid.length)[..., :lags])


def _multiply_delayed(grid: _Grid, section: _Section, weights: ComplexArray) -> FloatArray:
    """Multiply the states of a section at all delays, weighted, (D, n, n)."""
    states = section.simulate(grid)
    n = len(states)
    products = np.empty((grid.longest_delay + 1, n, n))
    for i, j in combinations_with_replacement(range(n), 2):
        transform = rfft(states[i] * states[j], grid.length, axis=0)
        found = _correlate(grid, transform, weights, len(products))
        products[:, i, j] = products[:, j, i] = found
    return products


def _find_section(
    grid: _Grid, rows: _Rows, sections: Sequence[_Section], shapes: Sequence[_Shape]
) -> _Section | None:
    """Find the section that explains most of what the others leave; None if they are enough.

    All delays are tried, orthogonal to the columns of the others (orthogonal least squares: Chen,
    Billings and Luo, Int. J. Control 50 (1989) 1873). A pair has one more parameter than a pole for
    each of its states, and pays for it by Schwarz's criterion.
    """
    root = np.sqrt(rows.weight)
    fixed = np.linalg.qr(root[:, None] * _read_columns(grid, sections, rows))[0]
    errors = root * rows.value
    errors = errors - fixed @ (fixed.T @ errors)
    targets = rfft(_spread(grid, rows, root * np.vstack([errors, fixed.T])), grid.length, axis=1)
    correlations = [
        np.ascontiguousarray(_correlate(grid, one, targets, grid.points)[:, ::-1].T)
        for one in grid.spectra
    ]
    squares, best, least = float(errors @ errors), None, np.inf
    used = fixed.shape[1] + sum(one.place.size for one in sections)
    has_slow = any(one.place[1] < grid.slow for one in sections)
    for one, products in shapes:
        poles = sum(other.order for other in sections if other.channel == one.channel)
        added = one.order * (1 + grid.experiments) + one.place.size
        if (
            poles + one.order > _MOST_POLES
            or (has_slow and one.place[1] < grid.slow)
            or _ROWS_PER_PARAMETER * (used + added) > rows.value.size
        ):
            continue
        explained = _scan_delays(one, products, correlations[one.channel])
        delay = int(np.argmax(explained))
        left = max(squares - float(explained[delay]), 1e-12 * squares)
        cost = rows.value.size * log(left) + 2 * one.order * log(rows.value.size)
        if cost < least:
            best, least = _Section(one.channel, np.array([delay, *one.place[1:]])), cost
    return best


def _scan_delays(section: _Section, products: FloatArray, correlations: FloatArray) -> FloatArray:
    """Compute the squares (D,) that a section explains at all delays beside fixed columns.

    `correlations` (G, 1 + P) are those of its input with errors and columns, the latest first. A
    state is a decaying sum of the input, so its correlations are decaying sums of them.
    """
    sums = sum_with_decay(correlations, section.decay, len(products))[:, ::-1]
    own, fixed = sums[:, :, 0], sums[:, :, 1:].transpose(1, 0, 2)
    sizes = np.mean(products.diagonal(axis1=1, axis2=2), axis=0)
    grams = products - fixed @ fixed.transpose(0, 2, 1)
    grams += 1e-6 * np.diag(np.maximum(sizes, 1e-300))
    if section.order == 1:
        return np.asarray(np.square(own[0]) / grams[:, 0, 0])
    (first, shared), (_, second) = grams.transpose(1, 2, 0)
    along = second * own[0] ** 2 + first * own[1] ** 2 - 2.0 * shared * own[0] * own[1]
    return np.asarray(along / (first * second - shared**2))
