"""The time grid of a simulation, and where the measured samples lie on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from sysid.core.errors import InvalidRecord, InvalidSettings
from sysid.core.types import FloatArray
from sysid.data.interpolation import estimate_sampling_period
from sysid.data.records import Channel
from sysid.kernels.signals.past_reads import is_difference
from sysid.models.model import Model

MAX_STEPS = 20_000_000
"""Limit on the integration steps of one experiment."""

_JITTER = 0.05  # of a sampling period: tolerated by a recursion
_POINTS_PER_SAMPLE = 4  # grid points in the median distance of irregular samples
GRID_TOLERANCE = 0.01  # of a grid step: a nearer sample counts as on the point


@dataclass(frozen=True, slots=True)
class Grid:
    """Grid points `start` + n · `step`, each step divided into `substeps` integration steps."""

    start: float
    step: float
    points: int
    substeps: int

    @property
    def integration_step(self) -> float:
        """Integration step in s; for a recursion its period h."""
        return self.step / self.substeps

    @property
    def last_step(self) -> int:
        """Index of the last integration step."""
        return (self.points - 1) * self.substeps

    @property
    def times(self) -> FloatArray:
        """Times of the grid points in s."""
        return self.start + self.step * np.arange(self.points, dtype=np.float64)

    @property
    def duration(self) -> float:
        """Time from the first grid point to the last, in s."""
        return self.step * (self.points - 1)

    def locate_times(self, times: FloatArray) -> FloatArray:
        """Convert times to positions in grid steps; whole numbers where they are on the grid."""
        positions = (times - self.start) / self.step
        whole = np.round(positions)
        snapped: FloatArray = np.where(np.abs(positions - whole) < GRID_TOLERANCE, whole, positions)
        return np.clip(snapped, 0.0, self.points - 1.0)


def make_grid(
    model: Model, inputs: Sequence[Channel], outputs: Sequence[Channel], since: float
) -> Grid:
    """Make the grid on which a model is compared with an experiment, from `since` (s) at least.

    Raises
    ------
    InvalidRecord
        If a recursion meets irregular samples, or the samples are too few.
    InvalidSettings
        If the grid is too long.
    """
    if is_difference(model):
        return _make_sample_grid(outputs, model.solver.substeps)
    step = model.solver.step or _choose_simulation_step(outputs)
    first = min(float(channel.times[0]) for channel in outputs)
    begin = min([first, since, *(float(channel.times[0]) for channel in inputs)])
    end = max(float(channel.times[-1]) for channel in outputs)
    _check_length((end - begin) / step * model.solver.substeps)
    start = first - ceil((first - begin) / step - 1e-6) * step
    points = ceil((end - start) / step - GRID_TOLERANCE) + 1
    return Grid(start, step, points, model.solver.substeps)


def locate_samples(grid: Grid, model: Model, channel: Channel) -> FloatArray:
    """Locate the samples of an output on the grid; whole numbers for a recursion."""
    if not is_difference(model):
        return grid.locate_times(channel.times)
    positions = (channel.times - grid.start) / grid.step
    whole: FloatArray = np.round(positions)
    worst = int(np.argmax(np.abs(positions - whole)))
    if abs(positions[worst] - whole[worst]) > _JITTER:
        raise InvalidRecord(
            f"output {channel.name!r} is not sampled regularly: sample {worst} at "
            f"{channel.times[worst]:g} s is off the period of {grid.step:g} s. A difference "
            "equation needs regular samples. Resample the record or use a differential model"
        )
    if np.any(np.diff(whole) < 1):
        repeated = int(np.argmax(np.diff(whole) < 1)) + 1
        raise InvalidRecord(
            f"output {channel.name!r} has two samples at {channel.times[repeated]:g} s. "
            "A difference equation needs one"
        )
    return whole


def is_on_grid(positions: FloatArray) -> bool:
    """Return whether each sample has its own grid point."""
    return bool(np.all(positions == np.round(positions)) and np.all(np.diff(positions) > 0))


def _make_sample_grid(outputs: Sequence[Channel], substeps: int) -> Grid:
    period = _find_output_period(outputs)
    start = min(float(channel.times[0]) for channel in outputs)
    end = max(float(channel.times[-1]) for channel in outputs)
    _check_length((end - start) / period * substeps)
    return Grid(start, period, round((end - start) / period) + 1, substeps)


def _choose_simulation_step(outputs: Sequence[Channel]) -> float:
    """Choose the outputs' period, or a fraction of it where their samples are irregular."""
    period = _find_output_period(outputs)
    first = min(float(channel.times[0]) for channel in outputs)
    for channel in outputs:
        positions = (channel.times - first) / period
        if np.any(np.abs(positions - np.round(positions)) > _JITTER):
            return period / _POINTS_PER_SAMPLE
    return period


def _find_output_period(outputs: Sequence[Channel]) -> float:
    periods = [p for p in (_estimate_period(channel) for channel in outputs) if p is not None]
    if not periods:
        raise InvalidRecord(
            f"output {outputs[0].name!r} has samples at one time only. Need two times or more"
        )
    return min(periods)


def _estimate_period(channel: Channel) -> float | None:
    """Estimate the sampling period; for irregular samples the median distance.

    Times are often written with few digits, so each distance and their median are a little wrong.
    Over 20,000 samples the error adds up to whole periods. The mean over all samples is right.
    """
    median = estimate_sampling_period(channel)
    if median is None:
        return None
    counts = np.concatenate([[0.0], np.cumsum(np.round(np.diff(channel.times) / median))])
    if counts[-1] == 0:
        return median
    mean = float(channel.times[-1] - channel.times[0]) / float(counts[-1])
    off = np.abs(channel.times - channel.times[0] - mean * counts)
    return mean if float(np.max(off)) < _JITTER * mean else median


def _check_length(steps: float) -> None:
    if steps > MAX_STEPS:
        raise InvalidSettings(
            "/model/solver/step",
            f"the simulation needs {steps:.3g} steps, but the limit is {MAX_STEPS:g}. "
            "Set a longer step or cut the record",
        )
