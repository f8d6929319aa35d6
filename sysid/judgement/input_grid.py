"""Inputs on a regular grid, and the rows of a fit that lie on it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.fft import rfft

from sysid.core.types import BoolArray, ComplexArray, FloatArray, IntArray
from sysid.data.records import Channel, Record
from sysid.residuals.autocorrelation import pad_length

_LONGEST_DELAY = 1.0 / 3.0  # of the record
_SLOWEST = 100.0  # records: a longer time constant is an integrator


class GridRows(NamedTuple):
    """Rows (R,) of a fit: experiment, position on the grid, centred value, root of the weight.

    `block` numbers the halves of blocks, from 0; it is -1 for a row that is never left out.
    """

    experiment: IntArray
    position: FloatArray
    value: FloatArray
    root: FloatArray
    block: IntArray


class InputGrid(NamedTuple):
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


def make_input_grid(
    records: Sequence[Record],
    moving: Sequence[str],
    starts: FloatArray,
    longest: float,
    step: float,
) -> InputGrid:
    """Place the inputs on a grid that begins, for each experiment, at its start (s).

    `longest` is the duration (s) of the longest experiment.
    """
    points = int(np.ceil(longest / step)) + 3
    before = max(start - _find_first_time(r) for start, r in zip(starts, records, strict=True))
    if len(records) > 1:  # each starts where its input was held, at a value of its own
        before = _LONGEST_DELAY * points * step
    first = int(np.clip(before / step, 0.0, _LONGEST_DELAY * points))
    inputs = np.zeros((len(records), len(moving), first + points))
    for number, record in enumerate(records):
        edges = starts[number] + step * (np.arange(first + points + 1.0) - first - 1.0)
        for channel in record.inputs:
            if channel.name in moving:
                inputs[number, moving.index(channel.name)] = average_input(channel, edges)
    inputs -= np.mean(inputs[:, :, :1], axis=0)
    sizes = np.sqrt(np.mean(np.square(inputs), axis=(0, 2), keepdims=True))
    inputs /= np.where(sizes > 0, sizes, 1.0)
    length = pad_length(2 * (first + points))
    return InputGrid(step, first, inputs, rfft(inputs, length, axis=2), length)


def _find_first_time(record: Record) -> float:
    return min(
        (channel.history_and_samples.times[0] for channel in record.inputs), default=record.start
    )


def average_input(channel: Channel, edges: FloatArray) -> FloatArray:
    """Average an input between the edges (G + 1,); its ends are held outside the record."""
    channel = channel.acting
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


def average_rows(rows: GridRows) -> GridRows:
    """Average the rows of each step of the grid, apart for each experiment and block."""
    keys = np.stack([rows.experiment, rows.block, np.floor(rows.position).astype(np.int64)])
    begins = np.flatnonzero(np.any(np.diff(keys, axis=1, prepend=-2) != 0, axis=0))
    counts = np.diff(np.append(begins, rows.value.size))
    return GridRows(
        rows.experiment[begins],
        np.add.reduceat(rows.position, begins) / counts,
        np.add.reduceat(rows.value, begins) / counts,
        np.sqrt(counts),
        rows.block[begins],
    )


def take_rows(rows: GridRows, chosen: BoolArray | slice) -> GridRows:
    """Take some of the rows."""
    return GridRows._make(column[chosen] for column in rows)
