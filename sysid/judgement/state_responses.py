"""Responses of linear models to inputs on a grid: their states, exact for every pole.

A model is a chain of sections, so that it has no canonical form that poles near one would spoil.
"""

from typing import NamedTuple

import numpy as np
from numpy.fft import irfft, rfft

from sysid.core.types import FloatArray, IntArray
from sysid.judgement.input_grid import GridRows, InputGrid


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


def compute_impulses(shapes: FloatArray, points: int) -> FloatArray:
    """Compute the impulse responses (B, n, G) of the states, by doubling."""
    power, drive = _discretise(shapes)
    impulses = drive[:, :, None]
    while impulses.shape[2] < points:
        impulses = np.concatenate([impulses, power @ impulses], axis=2)
        power = power @ power
    return impulses[:, :, :points]


class StateSignals(NamedTuple):
    """Signals of B shapes on the grid.

    Responses to every input (B, U, n, E · G), free responses (B, n, G), response to a step (B, G).
    """

    responses: FloatArray
    free: FloatArray
    step: FloatArray

    def select(self, number: int) -> "StateSignals":
        """Select those of one shape."""
        return StateSignals(*(signal[number : number + 1] for signal in self))


def compute_responses(grid: InputGrid, impulses: FloatArray) -> StateSignals:
    """Simulate the states of impulse responses (B, n, G) for every input, from rest."""
    count, order, _ = impulses.shape
    responses = convolve_inputs(grid, np.repeat(impulses[:, None], grid.inputs.shape[1], axis=1))
    last = (order - 1) // 2 * 2  # the value of the last section
    return StateSignals(
        responses.reshape(count, grid.inputs.shape[1], order, -1),
        impulses / np.maximum(np.max(np.abs(impulses), axis=2, keepdims=True), 1e-300),
        np.cumsum(impulses[:, last], axis=1),
    )


def convolve_inputs(grid: InputGrid, impulses: FloatArray) -> FloatArray:
    """Convolve impulse responses (B, U, n, G) with the inputs, (B, U, n, E, G)."""
    transform = rfft(impulses, grid.length, axis=3)[:, :, :, None]
    inputs = grid.spectra.transpose(1, 0, 2)[None, :, None]
    return np.asarray(irfft(transform * inputs, grid.length, axis=4)[..., : grid.points])


class GridPlaces(NamedTuple):
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


def locate_points(position: FloatArray, points: int, offset: IntArray | int = 0) -> GridPlaces:
    """Locate positions (R,) on a grid; one before it is read at its first point."""
    index = np.clip(np.floor(position).astype(np.int64), 0, points - 2)
    return GridPlaces(index + offset, np.clip(position - index, 0.0, 1.0))


def locate_delayed(grid: InputGrid, delays: FloatArray, rows: GridRows) -> list[GridPlaces]:
    """Locate rows on the joined grids of the experiments, for each input."""
    offset = rows.experiment * grid.points
    return [locate_points(rows.position - delay, grid.points, offset) for delay in delays]


def read_columns(
    grid: InputGrid, signals: StateSignals, delays: FloatArray, rows: GridRows
) -> FloatArray:
    """Read the columns (B, P, R) of rows for delays (U,) in steps, times the roots of weights."""
    count, _, order, _ = signals.responses.shape
    driven = [
        places.read(signals.responses[:, u])
        for u, places in enumerate(locate_delayed(grid, delays, rows))
    ]
    since = locate_points(rows.position - grid.first, grid.points)
    free, experiments = since.read(signals.free), grid.inputs.shape[0]
    if experiments > 1:
        is_own = rows.experiment == np.arange(experiments)[:, None]
        free = (free[:, None] * is_own[None, :, None]).reshape(count, experiments * order, -1)
    columns = np.concatenate([*driven, free, since.read(signals.step)[:, None]], axis=1)
    columns *= rows.root
    return np.asarray(columns)


def read_plain_columns(
    grid: InputGrid, signals: StateSignals, delays: FloatArray, samples: GridRows
) -> FloatArray:
    """Read the columns (P, N) of one shape for samples, without weights."""
    plain = samples._replace(root=np.ones(samples.value.size))
    return np.asarray(read_columns(grid, signals, delays, plain)[0])
