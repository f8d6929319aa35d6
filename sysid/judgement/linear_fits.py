"""Linear models of order 1 to 4 with time lags, fitted by their simulation error.

Numerators, starts and an offset enter linearly and are projected out (Golub and Pereyra 1973).
Poles and time lags are moved by Levenberg–Marquardt. The starting points are the peaks of a scan:
shapes of one or two poles by all time lags, by FFT.
"""

from collections.abc import Iterator, Sequence
from math import exp, log
from typing import NamedTuple

import numpy as np
from numpy.fft import irfft, rfft

from sysid.core.types import FloatArray
from sysid.judgement.input_grid import GridRows, InputGrid, take_rows
from sysid.judgement.state_responses import (
    compute_impulses,
    compute_responses,
    convolve_inputs,
    locate_delayed,
    locate_points,
    read_columns,
)

ORDERS = (1, 2, 3, 4)
"""Orders that are tried."""

WORTHWHILE = 0.99  # of the squares: less is worth another order
_ROWS_PER_PARAMETER = 5
_ROWS = 500  # rows of a fit: a longer record is averaged, if its dynamics are slow enough
_STEPS_PER_TIME_CONSTANT = 12.0  # of the averaged record
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
_DIFFERENCE = 1e-3  # of a logarithm, for slopes by differences
_START_RIDGE = 1e-3  # noise over the prior deviation of a start, both in deviations of the output
_RIDGE = 1e-7  # of a column, against rounding


class LinearFit(NamedTuple):
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


def linearise(grid: InputGrid, rows: GridRows, shape: FloatArray, delays: FloatArray) -> LinearFit:
    """Fit the linear coefficients and compute the slopes over all parameters."""
    order, channels = shape.size, delays.size
    moved = np.vstack([shape, shape + _DIFFERENCE * np.eye(order)])
    impulses = compute_impulses(moved, grid.points)
    signals = compute_responses(grid, impulses[:1])
    [columns] = read_columns(grid, signals, delays, rows)
    [ridge] = make_ridge(columns[None], channels * order)
    gram = columns @ columns.T
    gram[np.diag_indices_from(gram)] += ridge
    value = rows.root * rows.value
    linear = solve_scaled(gram, columns @ value)
    errors = value - linear @ columns
    squares = float(errors @ errors + ridge @ np.square(linear))
    # The perturbed states are summed before they meet the inputs: one convolution for each input.
    change = (impulses[1:] - impulses[0]) / _DIFFERENCE
    driven = linear[: channels * order].reshape(channels, order)
    starts = linear[channels * order : -1].reshape(-1, order)
    starts = starts / np.maximum(np.max(np.abs(impulses[0]), axis=1), 1e-300)
    responses = convolve_inputs(grid, (driven @ change)[:, :, None]).reshape(order, channels, -1)
    last = (order - 1) // 2 * 2
    free = starts @ change + linear[-1] * np.cumsum(change[:, last], axis=1)[:, None]
    since = locate_points(rows.position - grid.first, grid.points, rows.experiment * grid.points)
    by_shape, by_delay = since.read(free.reshape(order, -1)), np.empty((channels, value.size))
    for u, places in enumerate(locate_delayed(grid, delays, rows)):
        by_shape += places.read(responses[:, u])
        summed = driven[u] @ signals.responses[0, u]
        by_delay[u] = -places.slope(summed, summed[places.point])
    whole = np.vstack([columns, rows.root * by_shape, rows.root * by_delay]).T
    tiny = _RIDGE**2 * np.einsum("rp,rp->p", whole[:, linear.size :], whole[:, linear.size :])
    return LinearFit(shape, delays, squares, whole, np.concatenate([ridge, tiny + 1e-200]), errors)


def make_ridge(columns: FloatArray, channels: int) -> FloatArray:
    """Make the ridge (B, P) of linear coefficients: starts are of the size of the output."""
    count = columns.shape[1]
    ridge = np.asarray(_RIDGE**2 * np.einsum("bpr,bpr->bp", columns, columns) + 1e-200)
    ridge[:, channels : count - 1] += _START_RIDGE**2
    return ridge


def solve_scaled(gram: FloatArray, right: FloatArray) -> FloatArray:
    """Solve symmetric systems (…, P, P) for right sides (…, P), scaled to a unit diagonal."""
    size = np.sqrt(np.maximum(np.einsum("...pp->...p", gram), 1e-300))
    scaled = gram / (size[..., :, None] * size[..., None, :])
    scaled = scaled + 1e-13 * np.eye(gram.shape[-1])
    return np.asarray(np.linalg.solve(scaled, (right / size)[..., None])[..., 0] / size)


def _clip_shape(grid: InputGrid, shape: FloatArray) -> FloatArray:
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


def _minimise(grid: InputGrid, rows: GridRows, shape: FloatArray, delays: FloatArray) -> LinearFit:
    """Minimise the squares over shape and delays (Levenberg 1944, Marquardt 1963)."""
    fit = linearise(grid, rows, _clip_shape(grid, shape), delays)
    damping = 1e-2
    for _ in range(_EVALUATIONS):
        gram = fit.columns.T @ fit.columns
        count = shape.size + delays.size
        extra = fit.ridge.copy()
        extra[-count:] += damping * gram.diagonal()[-count:]
        gram[np.diag_indices_from(gram)] += extra
        move = np.clip(solve_scaled(gram, fit.columns.T @ fit.errors)[-count:], -3.0, 3.0)
        trial = linearise(grid, rows, *move_parameters(grid, fit, move))
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


def move_parameters(
    grid: InputGrid, fit: LinearFit, move: FloatArray
) -> tuple[FloatArray, FloatArray]:
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


def _list_rates(grid: InputGrid) -> FloatArray:
    """List the rates of a scan, per step: from the whole record to a step."""
    count = int(np.ceil(_SHAPES_PER_DECADE * np.log10(grid.points))) + 1
    return np.geomspace(1.0 / grid.points, 1.0, count)


def _spread(grid: InputGrid, rows: GridRows, values: FloatArray) -> FloatArray:
    """Add weighted values (R,) up on the grid, (E, G)."""
    experiments, _, points = grid.inputs.shape
    place = np.rint(rows.position).astype(np.int64) + rows.experiment * points
    total = np.bincount(place, rows.root**2 * values, experiments * points)
    return np.asarray(total.reshape(experiments, points))


def _scan(grid: InputGrid, channel: int, target: FloatArray, shapes: FloatArray) -> _Peak:
    """Find the shape (of S, n) and the delay that explain a target (E, G) best, n = 1 or 2."""
    transform = rfft(compute_impulses(shapes, grid.points), grid.length, axis=2)
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


def _scan_inputs(grid: InputGrid, rows: GridRows, shapes: FloatArray) -> list[_Peak]:
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


def count_choices(grid: InputGrid) -> float:
    """Count the time lags and shapes that were tried for each input, and the orders: logarithm."""
    rates = _list_rates(grid).size
    each = (grid.longest_delay + 1) * rates * (1 + len(_SCANNED_DAMPING))
    return log(len(ORDERS)) + int(grid.inputs.shape[1]) * log(each)


def choose_stride(grid: InputGrid, rows: GridRows) -> int:
    """Choose how many samples are averaged: as many as slow dynamics and a long record allow."""
    most = rows.value.size // _ROWS
    if most < 2:
        return 1
    rates = np.geomspace(1.0 / grid.points, 1.0, 8)
    peaks = _scan_inputs(grid, rows, np.log(rates)[:, None])
    fastest = max(exp(peak.shape[0]) for peak in peaks)
    return int(np.clip(1.0 / (_STEPS_PER_TIME_CONSTANT * fastest), 1, most))


def fit_each_order(grid: InputGrid, rows: GridRows) -> Iterator[LinearFit]:
    """Fit one order after the other, as far as there are rows enough."""
    rates = np.log(_list_rates(grid))
    real = _scan_inputs(grid, rows, rates[:, None])
    pairs = [(rate, log(damping)) for rate in rates for damping in _SCANNED_DAMPING]
    resonant = _scan_inputs(grid, rows, np.array(pairs))
    fit: LinearFit | None = None
    for order in ORDERS:
        parameters = (order + 1) * sum(grid.inputs.shape[:2]) + order
        if _ROWS_PER_PARAMETER * parameters > rows.value.size:
            return
        starts = _list_starts(grid, order, real, resonant, fit)
        lower, fit = fit, _minimise(grid, rows, *_select_start(grid, rows, starts))
        yield fit
        is_settled = lower is not None and fit.squares > WORTHWHILE * lower.squares
        if is_settled and order > 2:  # a resonance may need two poles at once
            return


_Start = tuple[FloatArray, FloatArray]


def _list_starts(
    grid: InputGrid,
    order: int,
    real: Sequence[_Peak],
    resonant: Sequence[_Peak],
    previous: LinearFit | None,
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


def _select_start(grid: InputGrid, rows: GridRows, starts: Sequence[_Start]) -> _Start:
    """Select the start with the least squares, after a fit of the linear part to some rows."""
    some = take_rows(rows, slice(None, None, max(rows.value.size // _START_ROWS, 1)))
    value, best = some.root * some.value, (-np.inf, starts[0])
    signals, known = None, np.empty(0)
    for shapes, delays in starts:
        if signals is None or shapes is not known:
            known = shapes
            clipped = np.array([_clip_shape(grid, shape) for shape in shapes])
            signals = compute_responses(grid, compute_impulses(clipped, grid.points))
        columns = read_columns(grid, signals, delays, some)
        gram = columns @ columns.transpose(0, 2, 1)
        diagonal = np.arange(gram.shape[1])
        gram[:, diagonal, diagonal] += make_ridge(columns, shapes.shape[1] * delays.size)
        right = columns @ value
        explained = np.einsum("bp,bp->b", right, solve_scaled(gram, right))
        most = int(np.argmax(explained))
        if explained[most] > best[0]:
            best = (float(explained[most]), (shapes[most], delays))
    return best[1]
