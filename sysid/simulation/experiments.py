"""Records placed on the simulation grid: channels matched to signals, samples to grid points."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np

from sysid.core.errors import InvalidRecord, InvalidSettings, RecordTooShort, suggest_name
from sysid.core.settings import FitSettings
from sysid.core.types import BoolArray, FloatArray
from sysid.data.interpolation import FineInput
from sysid.data.records import Channel, Record
from sysid.kernels.signals.past_reads import is_difference, list_delaying_inputs
from sysid.language.tree import PastValue
from sysid.models.kalman_filter import match_measured_state
from sysid.models.model import (
    DerivedInitial,
    EstimatedInitial,
    FixedInitial,
    MeasuredInitial,
    Model,
    name_initial_state,
)
from sysid.models.parameters import Parameter
from sysid.simulation.experiment_arrays import (
    OutputSamples,
    StateStart,
    find_largest_delays,
    interpolate_inputs,
)
from sysid.simulation.grid import Grid, locate_samples, make_grid
from sysid.simulation.output_means import average_outputs, locate_mean

# Weights outside this range are mistakes. Squares of weighted residuals could overflow.
_MIN_WEIGHT, _MAX_WEIGHT = 1e-100, 1e100


@dataclass(frozen=True, slots=True, eq=False)
class GridExperiment:
    """One record on the grid of a model.

    Attributes
    ----------
    grid : Grid
    inputs, outputs, starts : tuple
        In the model's order of inputs, outputs and states.
    first_inputs : tuple of float
        Values of the inputs at the start.
    largest_delay_steps : float
        Largest delay of a state, in integration steps.
    """

    grid: Grid
    inputs: tuple[FineInput, ...]
    outputs: tuple[OutputSamples, ...]
    starts: tuple[StateStart, ...]
    first_inputs: tuple[float, ...]
    largest_delay_steps: float


def split_weights(settings: FitSettings, model: Model, experiments: int) -> FitSettings:
    """Split weights by experiment into one weight of each output and relative deviations.

    The weight of an output is the root mean square of its weights.

    Raises
    ------
    InvalidSettings
        If a weight names no output or is not a number from 1e-100 to 1e100, or if a list has not
        one for each experiment.
    """
    names = [output.name for output in model.outputs]
    weights = dict(settings.weights or {})
    deviations = np.ones((experiments, len(names)))
    for name, given in weights.items():
        if name not in names:
            raise InvalidSettings(
                f"/weights/{name}", f"the model has no output {name!r}{suggest_name(name, names)}"
            )
        if not isinstance(given, list | tuple | np.ndarray):
            weights[name] = _check_weight(name, given)
            continue
        if len(given) != experiments:
            need = f"need one for each of the {experiments} experiments, or one number"
            raise InvalidSettings(f"/weights/{name}", f"found {len(given)} weights; {need}")
        numbers = np.array([_check_weight(name, number) for number in given])
        weights[name] = float(np.sqrt(np.mean(np.square(numbers))))
        deviations[:, names.index(name)] = weights[name] / numbers
    if settings.weights is None or weights == settings.weights:
        return settings
    return replace(settings, weights=weights, deviations=tuple(map(tuple, deviations.tolist())))


def _check_weight(name: str, weight: Any) -> float:
    if not isinstance(weight, Real) or not _MIN_WEIGHT <= float(weight) <= _MAX_WEIGHT:
        need = f"need a number from {_MIN_WEIGHT:g} to {_MAX_WEIGHT:g}"
        raise InvalidSettings(f"/weights/{name}", f"{weight!r} is not a weight; {need}")
    return float(weight)


def compute_output_weights(
    model: Model, records: Sequence[Record], weights: Mapping[str, Any] | None, skip: int
) -> dict[str, float]:
    """Compute the weight of each output: the setting, or else 1 / its standard deviation.

    A single output has weight 1. Another weight would only change the unit of J, and with it the
    meaning of the loss scale and of the target RMS.

    Raises
    ------
    InvalidRecord
        If an output is constant and `weights` has no entry for it.
    """
    names = [output.name for output in model.outputs]
    if len(names) == 1:
        return {names[0]: 1.0}
    chosen = weights or {}
    return {
        name: chosen[name] if name in chosen else _compute_reciprocal_deviation(name, records, skip)
        for name in names
    }


def _compute_reciprocal_deviation(name: str, records: Sequence[Record], skip: int) -> float:
    values = np.concatenate(
        [_find_channel(r.outputs, name, "output").values[skip:] for r in records]
    )
    finite = values[np.isfinite(values)]
    if not finite.size:
        raise InvalidRecord(
            f"output {name!r} has no value after the first {skip} samples, so the fit has no data. "
            "Use a smaller skip or a longer record"
        )
    if np.ptp(finite) == 0.0:
        raise InvalidRecord(
            f"output {name!r} is constant, so its standard deviation gives no weight. "
            "Set the weights of the outputs"
        )
    return 1.0 / float(np.std(finite))


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
    """Place a record on the grid of a model; samples before `scored_from` (s) are not scored.

    Raises
    ------
    InvalidRecord, RecordTooShort, InvalidSettings
        If the record does not have what the model needs.
    """
    inputs = [_find_input(record, quantity.name) for quantity in model.inputs]
    selected = _select_outputs(model, record, None if simulates_only else (skip, scored_from))
    located = [locate_mean(channel) for channel in selected]
    outputs = [channel for channel, _ in located]
    grid = make_grid(model, inputs, outputs, min(begin for _, begin in located))
    if is_difference(model) and grid.last_step < model.memory:
        needed = model.memory * grid.integration_step
        raise RecordTooShort(grid.duration, needed, "the model's memory")
    since = _find_scoring_starts(model, grid, scored_from)
    if not simulates_only:
        for channel in outputs:
            _check_scored(channel, skip, since[channel.name])
    spans = _list_spans(parameters)
    rows = {p.name: i for i, p in enumerate(parameters)}
    averaged = average_outputs(model, [record])
    added = len(averaged.states) - len(model.states)
    return GridExperiment(
        grid,
        tuple(interpolate_inputs(model, inputs, spans, grid)),
        tuple(_make_samples(model, grid, c, weights[c.name], skip, since[c.name]) for c in outputs),
        (*_make_starts(model, grid, outputs, experiment, rows), *_start_integrals(added)),
        tuple(_read_first_value(channel, grid.start) for channel in inputs),
        max([0.0, *find_largest_delays(averaged, "state", spans, grid).values()]),
    )


def _list_spans(parameters: Sequence[Parameter]) -> dict[str, tuple[float, float]]:
    return {
        p.name: (p.lower, p.upper) if p.fixed is None else (p.fixed, p.fixed) for p in parameters
    }


def replace_inputs(
    placed: GridExperiment,
    model: Model,
    before: Record,
    record: Record,
    parameters: Sequence[Parameter],
) -> GridExperiment:
    """Replace the inputs of a placed experiment; the record has the same times and outputs.

    An input that is the same channel as `before` is not interpolated again.
    """
    if record is before:
        return placed
    inputs = [_find_input(record, quantity.name) for quantity in model.inputs]
    known = {
        quantity.name: fine
        for quantity, channel, fine in zip(model.inputs, inputs, placed.inputs, strict=True)
        if channel in before.inputs and not list_delaying_inputs(model)
    }
    spans = _list_spans(parameters)
    return replace(
        placed,
        inputs=tuple(interpolate_inputs(model, inputs, spans, placed.grid, known)),
        first_inputs=tuple(_read_first_value(channel, placed.grid.start) for channel in inputs),
    )


def replace_outputs(
    placed: GridExperiment,
    model: Model,
    record: Record,
    experiment: int,
    parameters: Sequence[Parameter],
    weights: Mapping[str, float],
    skip: int,
    scored_from: float,
) -> GridExperiment:
    """Replace the outputs of a placed experiment; the record has the same inputs and times."""
    selected, grid = _select_outputs(model, record, (skip, scored_from)), placed.grid
    outputs = [locate_mean(channel)[0] for channel in selected]
    added = len(placed.starts) - len(model.states)
    since = _find_scoring_starts(model, grid, scored_from)
    rows = {p.name: i for i, p in enumerate(parameters)}
    return replace(
        placed,
        outputs=tuple(
            _replace_samples(samples, grid, c, weights[c.name], skip, since[c.name])
            for samples, c in zip(placed.outputs, outputs, strict=True)
        ),
        starts=(*_make_starts(model, grid, outputs, experiment, rows), *_start_integrals(added)),
    )


def _select_outputs(
    model: Model, record: Record, scored: tuple[int, float] | None
) -> list[Channel]:
    """Select the measured outputs in the model's order; check their samples if they are scored."""
    outputs = [_find_channel(record.outputs, output.name, "output") for output in model.outputs]
    if scored is not None:
        for channel in outputs:
            _check_scored(channel, *scored)
    return outputs


def _find_channel(channels: Sequence[Channel], name: str, role: str) -> Channel:
    for channel in channels:
        if channel.name == name:
            return channel
    names = [channel.name for channel in channels]
    raise InvalidRecord(f"the record has no {role} {name!r}{suggest_name(name, names)}")


def _find_input(record: Record, name: str) -> Channel:
    channel = _find_channel(record.inputs, name, "input")
    bad = np.flatnonzero(~np.isfinite(channel.values))
    if bad.size:
        raise InvalidRecord(
            f"input {name!r} has no finite value at {channel.times[bad[0]]:g} s "
            f"(sample {bad[0]}, and {bad.size - 1} more). Fill the gap or trim the record"
        )
    return channel


def _check_scored(channel: Channel, skip: int, scored_from: float) -> None:
    if not np.any(_is_scored(channel, skip, scored_from)):
        later = "" if scored_from == -np.inf else f" and from {scored_from:g} s on"
        raise InvalidRecord(
            f"output {channel.name!r} has {channel.values.size} samples, but none with a value "
            f"after the first {skip}{later}. The fit has no data"
        )


def _find_scoring_starts(model: Model, grid: Grid, scored_from: float) -> dict[str, float]:
    """Find for each output the time (s) from which its samples are scored.

    A recursion that starts at measured values repeats them, so they say nothing about the model.
    """
    if not is_difference(model):
        return {output.name: scored_from for output in model.outputs}
    initial = {state.name: how for state, how in zip(model.states, model.initial, strict=True)}
    computed = grid.start + (max(model.memory, 1) - 0.5) * grid.integration_step
    return {
        output.name: max(scored_from, computed)
        if isinstance(initial.get(match_measured_state(output) or ""), MeasuredInitial)
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
    is_known = np.isfinite(channel.values)
    return OutputSamples(
        locate_samples(grid, model, channel),
        np.where(is_known, channel.values, 0.0),
        weights,
        _interpolate_to_grid(grid, channel),
        np.where(is_known, weight, 0.0),
    )


def _replace_samples(
    samples: OutputSamples,
    grid: Grid,
    channel: Channel,
    weight: float,
    skip: int,
    scored_from: float,
) -> OutputSamples:
    """Replace the values of samples; weights that are equal remain the same array."""
    weights = np.where(_is_scored(channel, skip, scored_from), weight, 0.0)
    is_known = np.isfinite(channel.values)
    return OutputSamples(
        samples.positions,
        np.where(is_known, channel.values, 0.0),
        samples.weights if np.array_equal(weights, samples.weights) else weights,
        _interpolate_to_grid(grid, channel),
        np.where(is_known, weight, 0.0),
    )


def _interpolate_to_grid(grid: Grid, channel: Channel) -> FloatArray:
    """Interpolate the measurement to the grid points."""
    return _interpolate_measurement(grid.times, channel)


def _interpolate_measurement(times: FloatArray, channel: Channel) -> FloatArray:
    """Interpolate the measurement linearly to any times; 0 if it has no sample."""
    is_measured = np.isfinite(channel.values)
    if not np.any(is_measured):
        return np.zeros(times.size)
    return np.interp(times, channel.times[is_measured], channel.values[is_measured])


def _make_starts(
    model: Model, grid: Grid, outputs: Sequence[Channel], experiment: int, rows: Mapping[str, int]
) -> list[StateStart]:
    starts = []
    for i, initial in enumerate(model.initial):
        if isinstance(initial, FixedInitial):
            starts.append(StateStart(np.array([initial.value])))
        elif isinstance(initial, DerivedInitial):
            starts.append(StateStart(np.zeros(1)))
        elif isinstance(initial, EstimatedInitial):
            row = rows[name_initial_state(model.states[i].name, experiment)]
            starts.append(StateStart(np.zeros(1), row))
        else:
            starts.append(StateStart(_read_measured_start(model, i, grid, outputs)))
    return starts


def _start_integrals(count: int) -> list[StateStart]:
    """Start the integrals of outputs that are means."""
    return [StateStart(np.zeros(1))] * count


def _read_first_value(channel: Channel, start: float) -> float:
    """Read an input at the start of the simulation: its first value if it begins later."""
    channel = channel.acting
    if channel.hold == "zero":
        last = int(np.searchsorted(channel.times, start, side="right")) - 1
        return float(channel.values[max(last, 0)])
    return float(np.interp(start, channel.times, channel.values))


def _read_measured_start(
    model: Model, state: int, grid: Grid, outputs: Sequence[Channel]
) -> FloatArray:
    """Read the first values of a measured state; the rate of one is its first difference.

    Raises
    ------
    InvalidRecord
        If no output measures the state or its integral.
    """
    measured = {match_measured_state(o): c for o, c in zip(model.outputs, outputs, strict=True)}
    name = model.states[state].name
    count = max(model.memory, 1) if is_difference(model) else 1
    if name in measured:
        times = grid.start + grid.integration_step * np.arange(count, dtype=np.float64)
        return _interpolate_measurement(times, measured[name])
    for other, equation in zip(model.states, model.equations, strict=True):
        if equation == PastValue(name, "state") and other.name in measured:
            return _compute_first_slope(measured[other.name])
    raise InvalidRecord(
        f"state {name!r} must start at its measured value, but no output measures it or its "
        "integral. Set its initial value, or bounds to estimate it"
    )


def _compute_first_slope(channel: Channel) -> FloatArray:
    is_measured = np.isfinite(channel.values)
    times, values = channel.times[is_measured], channel.values[is_measured]
    later = np.flatnonzero(np.diff(times) > 0)
    if later.size == 0:
        return np.zeros(1)
    i = int(later[0])
    return np.array([(values[i + 1] - values[i]) / (times[i + 1] - times[i])])
