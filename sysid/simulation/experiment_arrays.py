"""An experiment packed into two arrays that a kernel reads (see `sysid.kernels.layout`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Literal

import numpy as np

from sysid.core.types import FloatArray, IntArray
from sysid.data.interpolation import FineInput, interpolate_input
from sysid.data.records import Channel
from sysid.kernels.abi import LANES
from sysid.kernels.layout import ExperimentLayout, KernelVariant
from sysid.kernels.signals.past_reads import (
    find_averaged_inputs,
    find_furthest_offset,
    is_difference,
    list_delayed_values,
    list_delaying_inputs,
    list_stored_histories,
)
from sysid.language.functions import Interval
from sysid.language.value_intervals import bound_expression
from sysid.models.model import Model
from sysid.models.model_delays import check_record_length, has_known_past
from sysid.simulation.grid import Grid, is_on_grid

_HISTORY_SLACK = 512  # rows of history beyond the largest delay: they are moved so often


@dataclass(frozen=True, slots=True, eq=False)
class OutputSamples:
    """Measured samples of one output: positions on the grid, values (0: missing), weights."""

    positions: FloatArray
    values: FloatArray
    weights: FloatArray
    grid_values: FloatArray
    """The measurement interpolated to the grid points; empty where it is not needed."""
    precision: FloatArray
    """Weight of the sensor where a value was measured, scored or not, else 0."""


@dataclass(frozen=True, slots=True, eq=False)
class StateStart:
    """Start of a state: its first values, and its row of theta if it is estimated."""

    first_values: FloatArray
    row: int = -1


@dataclass(frozen=True, slots=True, eq=False)
class PackedExperiment:
    """One experiment as a kernel reads it."""

    ints: IntArray
    floats: FloatArray
    n_work: int


def find_largest_delays(
    model: Model, kind: str, parameters: Mapping[str, Interval], grid: Grid
) -> dict[str, float]:
    """Find the largest delay of each delayed signal of a kind, in integration steps.

    The delays are bounded by the bounds of the parameters. Those of a state with a history function
    need the record at most: before it the function is read.

    Raises
    ------
    RecordTooShort
        If a delay can be as long as the record.
    """
    largest: dict[str, float] = {}
    step = grid.integration_step
    for past in list_delayed_values(model, kind):
        if past.delay is None:
            continue
        check_record_length(model, past, parameters, step, grid.duration)
        upper = bound_expression(past.delay, parameters, step)[1]
        steps = upper if is_difference(model) else upper / step
        if has_known_past(model, past):
            steps = min(steps, grid.last_step + 1.0)
        largest[past.name] = max(steps, largest.get(past.name, 0.0))
    return largest


def interpolate_inputs(
    model: Model,
    channels: Sequence[Channel],
    parameters: Mapping[str, Interval],
    grid: Grid,
    known: Mapping[str, FineInput] | None = None,
) -> list[FineInput]:
    """Interpolate the inputs but `known` ones, as far back as the largest delays reach."""
    back = find_furthest_offset(model)
    spans = {**parameters, **_measure_ranges(model, channels, grid)}
    reach = find_largest_delays(model, "input", spans, grid)
    mean: Literal["around", "after"] = "after" if is_difference(model) else "around"
    averaged = find_averaged_inputs(model)
    fine_inputs = []
    for quantity, channel in zip(model.inputs, channels, strict=True):
        name = quantity.name
        if known and name in known:
            fine_inputs.append(known[name])
            continue
        delay_steps = reach.get(name, 0.0) + back + 1
        averaging = mean if name in averaged else None
        fine_inputs.append(
            interpolate_input(
                channel, grid.start, grid.integration_step, grid.last_step, delay_steps, averaging
            )
        )
    return fine_inputs


def _measure_ranges(
    model: Model, channels: Sequence[Channel], grid: Grid
) -> dict[str, tuple[float, float]]:
    """Measure the ranges of the inputs that delays read, at the points of the simulation."""
    ranges = {}
    names = list_delaying_inputs(model)
    for quantity, channel in zip(model.inputs, channels, strict=True):
        if quantity.name in names:
            fine = interpolate_input(
                channel, grid.start, grid.integration_step, grid.last_step, 1.0
            )
            ranges[quantity.name] = find_range(fine)
    return ranges


def find_range(fine: FineInput) -> tuple[float, float]:
    """Find the least and the largest value of an input."""
    return float(np.min(fine.values)), float(np.max(fine.values))


def pack_experiment(
    model: Model,
    variant: KernelVariant,
    grid: Grid,
    inputs: Sequence[FineInput],
    outputs: Sequence[OutputSamples],
    starts: Sequence[StateStart],
    first_inputs: Sequence[float],
    largest_delay_steps: float,
    scale: float,
    n_measured: int,
) -> PackedExperiment:
    """Pack one experiment into the arrays of a kernel.

    Parameters
    ----------
    first_inputs : sequence of float
        Values of the inputs at the start.
    largest_delay_steps : float
        Largest delay of a state, in integration steps.
    scale : float
        Scale of the soft-l1 loss.
    n_measured : int
        M, measured values of all experiments.
    """
    builder = _ArrayBuilder(ExperimentLayout.from_model(model))
    cap = ceil(
        largest_delay_steps
    )  # a delay rounded to whole steps may exceed its bound by part of one
    reach = cap + find_furthest_offset(model) + 5
    rows = max(min(grid.last_step + reach + 3, 2 * reach + _HISTORY_SLACK), 2 * reach + 3)
    builder.ints[:4] = [grid.last_step, reach, rows, n_measured]
    builder.floats[:3] = [grid.integration_step, cap, scale]
    for i, start in enumerate(starts):
        builder.floats[builder.layout.locate_initial(i)] = start.first_values[0]
        builder.write_entries(
            "state", i, row=start.row, given=builder.add_floats(start.first_values)
        )
    for i, value in enumerate(first_inputs):
        builder.floats[builder.layout.locate_first_input(i)] = value
    for i, signal in enumerate(inputs):
        offset = builder.add_floats(signal.values)
        builder.write_entries(
            "input",
            i,
            zero=offset + signal.start_index,
            points=signal.points_per_step,
            begin=signal.begin,
            end=signal.end,
            cap=signal.max_delay,
        )
    first = 0
    for i, samples in enumerate(outputs):
        add = _pack_grid_samples if variant.on_grid else _pack_scattered_samples
        add(builder, i, samples, grid, first)
        builder.write_entries(
            "output", i, first=first, grid=builder.add_floats(samples.grid_values)
        )
        if model.corrections:
            precision = np.zeros(grid.points)
            precision[samples.positions.astype(np.int64)] = samples.precision
            builder.write_entries("output", i, precision=builder.add_floats(precision))
        first += samples.positions.size
    columns = sum(history.columns for history in list_stored_histories(model))
    n_work = max(columns * rows * LANES, 1)
    return PackedExperiment(*builder.build_arrays(), n_work)


def replace_input_values(
    model: Model,
    ints: IntArray,
    floats: FloatArray,
    inputs: Sequence[FineInput],
    first_inputs: Sequence[float],
) -> None:
    """Replace, in place, the values of inputs in the arrays of an experiment."""
    layout = ExperimentLayout.from_model(model)
    for i, (signal, first) in enumerate(zip(inputs, first_inputs, strict=True)):
        offset = ints[layout.locate_input(i, "zero")] - signal.start_index
        floats[offset : offset + signal.values.size] = signal.values
        floats[layout.locate_first_input(i)] = first


def replace_measured(
    model: Model,
    ints: IntArray,
    floats: FloatArray,
    outputs: Sequence[OutputSamples],
    starts: Sequence[StateStart],
    *,
    on_grid: bool,
) -> None:
    """Replace, in place, what the values of outputs determine in the arrays of an experiment."""
    layout = ExperimentLayout.from_model(model)
    for i, start in enumerate(starts):
        floats[layout.locate_initial(i)] = start.first_values[0]
        given = ints[layout.locate_state(i, "given")]
        floats[given : given + start.first_values.size] = start.first_values
    for i, samples in enumerate(outputs):
        measured = floats[ints[layout.locate_output(i, "measured")] :]
        if on_grid:
            measured[samples.positions.astype(np.int64)] = samples.values
        else:
            measured[: samples.values.size] = samples.values
        grid = ints[layout.locate_output(i, "grid")]
        floats[grid : grid + samples.grid_values.size] = samples.grid_values


class _ArrayBuilder:
    """The two arrays of an experiment; values are appended behind their heads."""

    def __init__(self, layout: ExperimentLayout) -> None:
        self.layout = layout
        self.ints = [0] * layout.n_ints
        self.floats = [0.0] * layout.n_floats
        self._more_ints: list[IntArray] = []
        self._more_floats: list[FloatArray] = []
        self._n_ints, self._n_floats = layout.n_ints, layout.n_floats

    def write_entries(self, kind: str, number: int, **fields: int) -> None:
        """Write entries of a state, an input or an output into the head."""
        locate = getattr(self.layout, f"locate_{kind}")
        for field, value in fields.items():
            self.ints[locate(number, field)] = value

    def add_ints(self, values: IntArray) -> int:
        """Append integers and return their offset."""
        self._more_ints.append(values)
        self._n_ints += values.size
        return self._n_ints - values.size

    def add_floats(self, values: FloatArray) -> int:
        """Append floats and return their offset."""
        self._more_floats.append(values)
        self._n_floats += values.size
        return self._n_floats - values.size

    def build_arrays(self) -> tuple[IntArray, FloatArray]:
        """Build both arrays."""
        ints = np.concatenate([np.array(self.ints, dtype=np.int64), *self._more_ints])
        return ints, np.concatenate([np.array(self.floats), *self._more_floats])


def _pack_grid_samples(
    builder: _ArrayBuilder, i: int, samples: OutputSamples, grid: Grid, first: int
) -> None:
    """Pack dense arrays over the grid points: row of the prediction or -1, value, weight."""
    points = samples.positions.astype(np.int64)
    rows = np.full(grid.points, -1, dtype=np.int64)
    rows[points] = first + np.arange(points.size)
    values, weights = np.zeros(grid.points), np.zeros(grid.points)
    values[points], weights[points] = samples.values, samples.weights
    builder.write_entries(
        "output",
        i,
        samples=builder.add_ints(rows),
        measured=builder.add_floats(values),
        weight=builder.add_floats(weights),
    )


def _pack_scattered_samples(
    builder: _ArrayBuilder, i: int, samples: OutputSamples, grid: Grid, first: int
) -> None:
    """Pack for each grid interval (n - 1, n] the bounds of its samples and their positions."""
    interval = np.ceil(samples.positions)
    fraction = samples.positions - (interval - 1.0)
    interval_bounds = np.searchsorted(interval, np.arange(grid.points + 1), side="left")
    builder.write_entries(
        "output",
        i,
        samples=builder.add_ints(interval_bounds.astype(np.int64)),
        fraction=builder.add_floats(fraction),
        measured=builder.add_floats(samples.values),
        weight=builder.add_floats(samples.weights),
    )


def are_on_grid(outputs: Sequence[OutputSamples]) -> bool:
    """Return whether each sample of each output has its own grid point."""
    return all(is_on_grid(samples.positions) for samples in outputs)


def has_weights(outputs: Sequence[OutputSamples], grid: Grid, on_grid: bool) -> bool:
    """Return whether some weight is not 1; a grid point without a sample has weight 0."""
    return any(
        bool(np.any(samples.weights != 1.0)) or (on_grid and samples.positions.size != grid.points)
        for samples in outputs
    )
