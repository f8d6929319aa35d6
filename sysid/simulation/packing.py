"""The numbers of one experiment as a kernel reads them (see `sysid.kernels.layout`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Literal

import numpy as np

from sysid.core.types import FloatArray, IntArray, Interval
from sysid.data.interpolation import FineInput, interpolate_input
from sysid.data.records import Channel
from sysid.kernels.abi import LANES
from sysid.kernels.layout import ExperimentLayout, KernelVariant
from sysid.kernels.reads import (
    find_averaged_inputs,
    find_furthest_offset,
    is_difference,
    list_delayed_values,
    list_states_with_history,
)
from sysid.language.intervals import bound_expression
from sysid.models.delays import check_record_length
from sysid.models.model import Model
from sysid.simulation.grid import Grid, is_on_grid

_HISTORY_SLACK = 512  # rows of history besides those that lags reach back: how often they are moved


@dataclass(frozen=True, slots=True, eq=False)
class OutputSamples:
    """Measured samples of one output: places on the grid, values (0: missing), weights."""

    places: FloatArray
    values: FloatArray
    weights: FloatArray
    grid_values: FloatArray
    """The measurement interpolated to the grid points; empty where it is not needed."""


@dataclass(frozen=True, slots=True, eq=False)
class StateStart:
    """How a state starts: given first values, and the row of theta if it is estimated."""

    first_values: FloatArray
    row: int = -1


@dataclass(frozen=True, slots=True, eq=False)
class PackedExperiment:
    """What a kernel gets for one experiment."""

    ints: IntArray
    floats: FloatArray
    n_work: int


def find_largest_delays(
    model: Model, kind: str, parameters: Mapping[str, Interval], grid: Grid
) -> dict[str, float]:
    """Largest lag of each lagged signal of a kind, in integration steps, inside the bounds.

    Raises
    ------
    RecordTooShort
        If a lag may be as long as the record.
    """
    largest: dict[str, float] = {}
    step = grid.integration_step
    for past in list_delayed_values(model, kind):
        if past.delay is None:
            continue
        check_record_length(model, past, parameters, step, grid.duration)
        upper = bound_expression(past.delay, parameters, step)[1]
        steps = upper if is_difference(model) else upper / step
        largest[past.name] = max(steps, largest.get(past.name, 0.0))
    return largest


def interpolate_inputs(
    model: Model, channels: Sequence[Channel], parameters: Mapping[str, Interval], grid: Grid
) -> list[FineInput]:
    """The inputs between their samples, as far back as the lags may reach."""
    reach = find_largest_delays(model, "input", parameters, grid)
    back = find_furthest_offset(model)
    mean: Literal["around", "after"] = "after" if is_difference(model) else "around"
    averaged = find_averaged_inputs(model)
    laid = []
    for quantity, channel in zip(model.inputs, channels, strict=True):
        name = quantity.name
        lag = reach.get(name, 0.0) + back + 1
        how = mean if name in averaged else None
        laid.append(
            interpolate_input(channel, grid.start, grid.integration_step, grid.last_step, lag, how)
        )
    return laid


def pack_experiment(
    model: Model,
    variant: KernelVariant,
    grid: Grid,
    inputs: Sequence[FineInput],
    outputs: Sequence[OutputSamples],
    starts: Sequence[StateStart],
    lag: float,
    scale: float,
) -> PackedExperiment:
    """Lay out one experiment.

    Parameters
    ----------
    lag : float
        Largest lag of a state, in integration steps.
    scale : float
        Scale of the soft-l1 loss.
    """
    page = _ArrayBuilder(ExperimentLayout.from_model(model))
    cap = ceil(lag)  # a lag rounded to whole steps may exceed its bound by part of one
    reach = cap + find_furthest_offset(model) + 5
    rows = max(min(grid.last_step + reach + 3, 2 * reach + _HISTORY_SLACK), 2 * reach + 3)
    page.ints[:3] = [grid.last_step, reach, rows]
    page.floats[:3] = [grid.integration_step, cap, scale]
    for i, start in enumerate(starts):
        page.floats[page.layout.locate_initial(i)] = start.first_values[0]
        page.write_entries("state", i, row=start.row, given=page.add_floats(start.first_values))
    for i, signal in enumerate(inputs):
        place = page.add_floats(signal.values)
        page.write_entries(
            "input",
            i,
            zero=place + signal.start_index,
            points=signal.points_per_step,
            begin=signal.begin,
            end=signal.end,
            cap=signal.max_delay,
        )
    first = 0
    for i, samples in enumerate(outputs):
        add = _pack_grid_samples if variant.on_grid else _pack_scattered_samples
        add(page, i, samples, grid, first)
        page.write_entries("output", i, first=first, grid=page.add_floats(samples.grid_values))
        first += samples.places.size
    n_work = max(len(list_states_with_history(model)) * rows * LANES, 1)
    return PackedExperiment(*page.build_arrays(), n_work)


class _ArrayBuilder:
    """The two arrays, growing behind their heads."""

    def __init__(self, layout: ExperimentLayout) -> None:
        self.layout = layout
        self.ints = [0] * layout.n_ints
        self.floats = [0.0] * layout.n_floats
        self._more_ints: list[IntArray] = []
        self._more_floats: list[FloatArray] = []
        self._n_ints, self._n_floats = layout.n_ints, layout.n_floats

    def write_entries(self, kind: str, number: int, **fields: int) -> None:
        """Write entries of a state, an input or an output into the head."""
        place = getattr(self.layout, f"locate_{kind}")
        for field, value in fields.items():
            self.ints[place(number, field)] = value

    def add_ints(self, values: IntArray) -> int:
        """Append whole numbers; gives their place."""
        self._more_ints.append(values)
        self._n_ints += values.size
        return self._n_ints - values.size

    def add_floats(self, values: FloatArray) -> int:
        """Append numbers; gives their place."""
        self._more_floats.append(values)
        self._n_floats += values.size
        return self._n_floats - values.size

    def build_arrays(self) -> tuple[IntArray, FloatArray]:
        """Both arrays as a whole."""
        ints = np.concatenate([np.array(self.ints, dtype=np.int64), *self._more_ints])
        return ints, np.concatenate([np.array(self.floats), *self._more_floats])


def _pack_grid_samples(
    page: _ArrayBuilder, i: int, samples: OutputSamples, grid: Grid, first: int
) -> None:
    """Dense arrays over the grid points: row of the prediction or -1, value, weight."""
    points = samples.places.astype(np.int64)
    rows = np.full(grid.points, -1, dtype=np.int64)
    rows[points] = first + np.arange(points.size)
    values, weights = np.zeros(grid.points), np.zeros(grid.points)
    values[points], weights[points] = samples.values, samples.weights
    page.write_entries(
        "output",
        i,
        samples=page.add_ints(rows),
        measured=page.add_floats(values),
        weight=page.add_floats(weights),
    )


def _pack_scattered_samples(
    page: _ArrayBuilder, i: int, samples: OutputSamples, grid: Grid, first: int
) -> None:
    """Per grid interval (n - 1, n]: the bounds of its samples and their positions inside it."""
    interval = np.ceil(samples.places)
    fraction = samples.places - (interval - 1.0)
    bounds_ = np.searchsorted(interval, np.arange(grid.points + 1), side="left")
    page.write_entries(
        "output",
        i,
        samples=page.add_ints(bounds_.astype(np.int64)),
        fraction=page.add_floats(fraction),
        measured=page.add_floats(samples.values),
        weight=page.add_floats(samples.weights),
    )


def are_on_grid(outputs: Sequence[OutputSamples]) -> bool:
    """Whether every output has its samples on grid points of their own."""
    return all(is_on_grid(samples.places) for samples in outputs)


def has_weights(outputs: Sequence[OutputSamples], grid: Grid, on_grid: bool) -> bool:
    """Whether some weight is not 1; a grid point without a sample has weight 0."""
    return any(
        bool(np.any(samples.weights != 1.0)) or (on_grid and samples.places.size != grid.points)
        for samples in outputs
    )
