"""Laying out experiments: which recorded channel is which signal, where it lies on the grid."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sysid.core.errors import InvalidRecord, InvalidSettings, RecordTooShort, suggest_name
from sysid.core.types import BoolArray, FloatArray
from sysid.data.interpolation import FineInput
from sysid.data.records import Channel, Record
from sysid.kernels.reads import is_difference
from sysid.language.tree import PastValue, match_plain_state
from sysid.models.model import (
    EstimatedInitial,
    FixedInitial,
    MeasuredInitial,
    Model,
    name_initial_state,
)
from sysid.models.parameters import Parameter
from sysid.simulation.grid import Grid, locate_samples, make_grid
from sysid.simulation.packing import (
    OutputSamples,
    StateStart,
    find_largest_delays,
    interpolate_inputs,
)

# Beyond these, a weight is a mistake, and squares of weighted residuals might not be numbers.
_LEAST_WEIGHT, _MOST_WEIGHT = 1e-100, 1e100


@dataclass(frozen=True, slots=True, eq=False)
class GridExperiment:
    """One record laid out for a model.

    Attributes
    ----------
    grid : Grid
    inputs, outputs, starts : tuple
        In the model's order of inputs, outputs and states.
    lag : float
        Largest lag of a state, in integration steps.
    """

    grid: Grid
    inputs: tuple[FineInput, ...]
    outputs: tuple[OutputSamples, ...]
    starts: tuple[StateStart, ...]
    largest_delay_steps: float


def compute_output_weights(
    model: Model, records: Sequence[Record], weights: Mapping[str, float] | None, skip: int
) -> dict[str, float]:
    """Weight of each output: 1 for one output, else as given or 1 / its standard deviation.

    With one output a weight would only change the unit of J, and the meaning of a loss scale and
    a target RMS with it; so none is applied.

    Raises
    ------
    InvalidSettings
        If a weight names no output or is not a number from 1e-100 to 1e100.
    InvalidRecord
        If an output without a given weight is constant.
    """
    names = [output.name for output in model.outputs]
    for name, weight in (weights or {}).items():
        if name not in names:
            raise InvalidSettings(
                f"/weights/{name}", f"the model has no output {name!r}{suggest_name(name, names)}"
            )
        if not _LEAST_WEIGHT <= weight <= _MOST_WEIGHT:
            need = f"need a number from {_LEAST_WEIGHT:g} to {_MOST_WEIGHT:g}"
            raise InvalidSettings(f"/weights/{name}", f"{weight!r} is not a weight; {need}")
    if len(names) == 1:
        return {names[0]: 1.0}
    given = weights or {}
    return {
        name: given[name] if name in given else _compute_reciprocal_deviation(name, records, skip)
        for name in names
    }


def _compute_reciprocal_deviation(name: str, records: Sequence[Record], skip: int) -> float:
    values = np.concatenate(
        [_find_channel(r.outputs, name, "output").values[skip:] for r in records]
    )
    seen = values[np.isfinite(values)]
    if not seen.size:
        raise InvalidRecord(
            f"output {name!r} has no value after the first {skip} samples, so nothing is left to "
            "compare with; give a smaller skip, or a longer record"
        )
    deviation = float(np.std(seen))
    if deviation == 0.0:
        raise InvalidRecord(
            f"output {name!r} is constant, so its standard deviation gives no weight; "
            "give weights for the outputs"
        )
    return 1.0 / deviation


def place_on_grid(
    model: Model,
    record: Record,
    experiment: int,
    parameters: Sequence[Parameter],
    weights: Mapping[str, float],
    skip: int,
    simulates_only: bool = False,
    scored_from: float = -np.inf,
) -> GridExperiment:
    """Lay one record out for a model; samples before `scored_from` (s) are not scored.

    Raises
    ------
    InvalidRecord, RecordTooShort, InvalidSettings
        If the record does not have what the model needs.
    """
    inputs = [_find_input(record, quantity.name) for quantity in model.inputs]
    outputs = _select_outputs(model, record, None if simulates_only else (skip, scored_from))
    grid = make_grid(model, inputs, outputs)
    if is_difference(model) and grid.last_step < model.memory:
        needed = model.memory * grid.integration_step
        raise RecordTooShort(grid.duration, needed, "the model's memory")
    since = _find_scoring_starts(model, grid, scored_from)
    if not simulates_only:
        for channel in outputs:
            _check_scored(channel, skip, since[channel.name])
    spans = {
        p.name: (p.lower, p.upper) if p.fixed is None else (p.fixed, p.fixed) for p in parameters
    }
    rows = {p.name: i for i, p in enumerate(parameters)}
    return GridExperiment(
        grid,
        tuple(interpolate_inputs(model, inputs, spans, grid)),
        tuple(_make_samples(model, grid, c, weights[c.name], skip, since[c.name]) for c in outputs),
        tuple(_make_starts(model, grid, outputs, experiment, rows)),
        max([0.0, *find_largest_delays(model, "state", spans, grid).values()]),
    )


def replace_outputs(
    laid: GridExperiment,
    model: Model,
    record: Record,
    experiment: int,
    parameters: Sequence[Parameter],
    weights: Mapping[str, float],
    skip: int,
    scored_from: float,
) -> GridExperiment:
    """What `place_on_grid` makes of a record whose inputs and times are those of one laid out before."""
    outputs, grid = _select_outputs(model, record, (skip, scored_from)), laid.grid
    since = _find_scoring_starts(model, grid, scored_from)
    rows = {p.name: i for i, p in enumerate(parameters)}
    return replace(
        laid,
        outputs=tuple(
            _make_samples(model, grid, c, weights[c.name], skip, since[c.name]) for c in outputs
        ),
        starts=tuple(_make_starts(model, grid, outputs, experiment, rows)),
    )


def _select_outputs(
    model: Model, record: Record, scored: tuple[int, float] | None
) -> list[Channel]:
    """The measured outputs in the model's order; each has samples that count, if any are to."""
    outputs = [_find_channel(record.outputs, output.name, "output") for output in model.outputs]
    if scored is not None:
        for channel in outputs:
            _check_scored(channel, *scored)
    return outputs


def _find_channel(channels: Sequence[Channel], name: str, role: str) -> Channel:
    for channel in channels:
        if channel.name == name:
            return channel
    known = [channel.name for channel in channels]
    raise InvalidRecord(f"the record has no {role} {name!r}{suggest_name(name, known)}")


def _find_input(record: Record, name: str) -> Channel:
    channel = _find_channel(record.inputs, name, "input")
    bad = np.flatnonzero(~np.isfinite(channel.values))
    if bad.size:
        raise InvalidRecord(
            f"input {name!r} has no finite value at {channel.times[bad[0]]:g} s "
            f"(sample {bad[0]}, and {bad.size - 1} more); fill the gap or trim the record"
        )
    return channel


def _check_scored(channel: Channel, skip: int, scored_from: float) -> None:
    if not np.any(_is_scored(channel, skip, scored_from)):
        later = "" if scored_from == -np.inf else f" and from {scored_from:g} s on"
        raise InvalidRecord(
            f"output {channel.name!r} has {channel.values.size} samples and none with a value "
            f"after the first {skip}{later}; nothing is left to compare with"
        )


def _find_scoring_starts(model: Model, grid: Grid, scored_from: float) -> dict[str, float]:
    """For each output the time (s) from which on its samples are scored.

    A recursion that starts at measured values repeats them: they say nothing about the model.
    """
    if not is_difference(model):
        return {output.name: scored_from for output in model.outputs}
    initial = {state.name: how for state, how in zip(model.states, model.initial, strict=True)}
    computed = grid.start + (max(model.memory, 1) - 0.5) * grid.integration_step
    return {
        output.name: max(scored_from, computed)
        if isinstance(initial.get(match_plain_state(output.expression) or ""), MeasuredInitial)
        else scored_from
        for output in model.outputs
    }


def _is_scored(channel: Channel, skip: int, scored_from: float) -> BoolArray:
    late = (np.arange(channel.times.size) >= skip) & (channel.times >= scored_from)
    return np.asarray(np.isfinite(channel.values) & late)


def _make_samples(
    model: Model, grid: Grid, channel: Channel, weight: float, skip: int, scored_from: float
) -> OutputSamples:
    weights = np.where(_is_scored(channel, skip, scored_from), weight, 0.0)
    values = np.where(np.isfinite(channel.values), channel.values, 0.0)
    return OutputSamples(
        locate_samples(grid, model, channel), values, weights, _interpolate_to_grid(grid, channel)
    )


def _interpolate_to_grid(grid: Grid, channel: Channel) -> FloatArray:
    """The measurement at the grid points."""
    return _interpolate_measurement(grid.times, channel)


def _interpolate_measurement(times: FloatArray, channel: Channel) -> FloatArray:
    """The measurement at any times, on a line between its samples; 0 if it has none."""
    known = np.isfinite(channel.values)
    if not np.any(known):
        return np.zeros(times.size)
    return np.interp(times, channel.times[known], channel.values[known])


def _make_starts(
    model: Model, grid: Grid, outputs: Sequence[Channel], experiment: int, rows: Mapping[str, int]
) -> list[StateStart]:
    starts = []
    for i, initial in enumerate(model.initial):
        if isinstance(initial, FixedInitial):
            starts.append(StateStart(np.array([initial.value])))
        elif isinstance(initial, EstimatedInitial):
            row = rows[name_initial_state(model.states[i].name, experiment)]
            starts.append(StateStart(np.zeros(1), row))
        else:
            starts.append(StateStart(_read_measured_start(model, i, grid, outputs)))
    return starts


def _read_measured_start(
    model: Model, state: int, grid: Grid, outputs: Sequence[Channel]
) -> FloatArray:
    """First values of a measured state; of its rate, the first difference.

    Raises
    ------
    InvalidRecord
        If no output measures the state or what it is the rate of.
    """
    measured = {
        match_plain_state(o.expression): c for o, c in zip(model.outputs, outputs, strict=True)
    }
    name = model.states[state].name
    count = max(model.memory, 1) if is_difference(model) else 1
    if name in measured:
        times = grid.start + grid.integration_step * np.arange(count, dtype=np.float64)
        return _interpolate_measurement(times, measured[name])
    for other, equation in zip(model.states, model.equations, strict=True):
        if equation == PastValue(name, "state") and other.name in measured:
            return _compute_first_slope(measured[other.name])
    raise InvalidRecord(
        f"state {name!r} is to start at its measured value, but no output measures it or what it "
        "is the rate of; give its initial value or bounds to estimate it in"
    )


def _compute_first_slope(channel: Channel) -> FloatArray:
    known = np.isfinite(channel.values)
    times, values = channel.times[known], channel.values[known]
    later = np.flatnonzero(np.diff(times) > 0)
    if later.size == 0:
        return np.zeros(1)
    i = int(later[0])
    return np.array([(values[i + 1] - values[i]) / (times[i + 1] - times[i])])
