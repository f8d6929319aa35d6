"""Simulation of a model with given parameter values."""

from __future__ import annotations  # help shows the names of types, not what they stand for

import re
from collections.abc import Mapping
from dataclasses import replace
from math import isfinite
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from sysid.core.errors import InvalidRecord, InvalidSettings, suggest_name
from sysid.core.types import FloatArray
from sysid.data.foreign_tables import describe_object, measure_distance, read_times
from sysid.data.holds import Hold
from sysid.data.records import Channel, Channels, Record, Recording, to_channels
from sysid.data.table_rules import TimeAxis, split_headings
from sysid.language.evaluation import evaluate_expression as value_of
from sysid.models.catalogue.load import ModelSource, resolve_model
from sysid.models.channel_assignment import name_inputs
from sysid.models.kalman_filter import is_noise_parameter
from sysid.models.model import (
    DerivedInitial,
    FixedInitial,
    InitialState,
    MeasuredInitial,
    Model,
    name_initial_state,
    replace_substeps,
)
from sysid.models.parameters import Parameter
from sysid.models.parse import keep_terms
from sysid.models.starts import replace_starts
from sysid.models.ties import resolve_ties
from sysid.simulation.problem import build_simulation_problem


class Identified(Protocol):
    """What an identification or an identified model has, to simulate it again."""

    @property
    def parameter_values(self) -> Mapping[str, float]:
        """Values of all parameters by name."""

    @property
    def holds(self) -> Mapping[str, Hold]:
        """How each input was read between its samples."""


def simulate(
    model: ModelSource,
    inputs: Channels | Record | Recording,
    values: Mapping[str, float] | Identified,
    *,
    channels: Mapping[str, str] | None = None,
    times: ArrayLike | None = None,
) -> Recording:
    """Simulate the outputs of a model at some times.

    With a result of `identify`, the model is simulated as it was identified: with its selected
    terms, its integration step, and its reading of the inputs. Several records have starts of
    their own; the first one's are taken. So is a measured start, unless `inputs` is a `Record` with
    measured outputs.

    Parameters
    ----------
    model : Model, str, Path or mapping
        A name of the catalogue, a YAML or JSON file, a document, or a model.
    inputs : Channel, sequence of Channel, table, Record or Recording
        One for each input of the model; others are ignored. A single one may have any name if the
        model has one input.
    values : mapping of str to float, Identification or IdentifiedModel
        Every parameter, inside or outside its bounds, and initial values such as ``x(0)``. Initial
        values that the model fixes are optional and replace its own. Parameters that the model
        fixes or ties to others are optional.
    channels : mapping of str to str, optional
        Model's input → channel's name. Default: by name, else as the result was identified.
    times : array of shape (N,), optional
        Seconds, not decreasing. For a difference equation they are regular and set its period.
        Default: the times of the first input.

    Returns
    -------
    Recording
        One channel for each output, ``inf`` or ``nan`` where the simulation diverged.

    Raises
    ------
    InvalidSettings
        If a value is missing, unknown or not finite.
    InvalidRecord, RecordTooShort
        If an input is missing or the times are too short for the model's delays.
    UnknownModel, InvalidModel
        If the model cannot be found or has faults.

    Examples
    --------
    A step of 2 % after 1 s.

    >>> t = [0.1 * k for k in range(100)]
    >>> step = Channel("u", t, [2.0 if time >= 1 else 0.0 for time in t])
    >>> values = {"K": 3.0, "T": 1.0, "L": 0.5, "y0": 0.0, "x(0)": 0.0}
    >>> answer = simulate("fopdt", step, values).channel("y")
    >>> print(f"{answer.values[-1]:.3f}")
    5.999
    """
    model, record, values = prepare_simulation(model, inputs, values, channels, times)
    values = complete_values(model, values)
    fixed_parameters = tuple(
        _fix_parameter(parameter, values[parameter.name]) for parameter in model.parameters
    )
    initial = tuple(
        _fix_initial(start, state.name, values, is_measured=_has_values(record))
        for start, state in zip(model.initial, model.states, strict=True)
    )
    problem = build_simulation_problem(
        replace(model, parameters=fixed_parameters, initial=initial), record
    )
    simulated = problem.split_by_output(problem.predict(np.empty((1, 0)))[0])[0]
    return Recording(tuple(replace(c, values=simulated[c.name].copy()) for c in record.outputs))


def prepare_simulation(
    model: ModelSource,
    inputs: Channels | Record | Recording,
    values: Mapping[str, float] | Identified,
    channels: Mapping[str, str] | None,
    times: ArrayLike | None,
) -> tuple[Model, Record, dict[str, float]]:
    """Prepare a simulation: the model as it was identified, a record, and checked values.

    The record has the model's inputs, and outputs at the times of the simulation. Their values are
    those measured for the starts, else missing. Parameters and errors are those of `simulate`.
    """
    model = resolve_model(model)
    kept = getattr(getattr(values, "data", None), "channels", None)
    signals = name_inputs(model, _read_inputs(inputs), _split_names(channels), kept)
    measured = _find_measured(inputs, values)
    if not isinstance(values, Mapping):
        model, signals, values = _restore(model, signals, values)
    check_values(model, values)
    at, start, _ = _choose_times(signals, times)
    outputs = tuple(
        Channel(
            output.name,
            at,
            _read_measured(measured, output.name, at),
            output.unit,
            started_at=start,
        )
        for output in model.outputs
    )
    return model, Record(signals, outputs), dict(values)


def _has_values(record: Record) -> bool:
    """Whether any output has measured values."""
    return any(np.isfinite(channel.values).any() for channel in record.outputs)


def _read_inputs(inputs: Channels | Record | Recording) -> tuple[Channel, ...]:
    if isinstance(inputs, Record):
        return inputs.inputs
    if isinstance(inputs, Recording):
        return inputs.channels
    return to_channels([(inputs, "the inputs")])[0]


def _split_names(channels: object) -> dict[str, str]:
    """Return names of channels without the unit that a table has in them."""
    if channels is None:
        return {}
    if not isinstance(channels, Mapping):
        detail = f"found {describe_object(channels)}; need a mapping of signals to channels"
        raise InvalidSettings("/channels", detail)
    return {key: split_headings([str(name)])[0][0] for key, name in channels.items()}


def _find_measured(
    inputs: Channels | Record | Recording, values: Mapping[str, float] | Identified
) -> tuple[Channel, ...]:
    """Find measured outputs, for initial states that start at them."""
    if isinstance(inputs, Record) and inputs.outputs:
        return inputs.outputs
    data = getattr(values, "data", None)
    return () if data is None else data.records[0].outputs


def _read_measured(measured: tuple[Channel, ...], name: str, times: FloatArray) -> FloatArray:
    """Read a measured output at times that begin where it begins; only its start is used."""
    for channel in measured:
        finite = np.isfinite(channel.values)
        if channel.name == name and np.any(finite):
            known = channel.times[finite]
            later = times - times[0] + channel.times[0]
            values: FloatArray = np.interp(later, known, channel.values[finite])
            return values
    return np.full(times.size, np.nan)


def _restore(
    model: Model, inputs: tuple[Channel, ...], found: Identified
) -> tuple[Model, tuple[Channel, ...], dict[str, float]]:
    """Restore model, inputs and values as they were identified."""
    numbers = getattr(found, "parameter_values", None)
    if not isinstance(numbers, Mapping):
        kind = type(found).__name__
        detail = f"found an object of type {kind}; need values by name, or a result of identify"
        raise InvalidSettings("/values", detail)
    terms = [term.term for term in getattr(found, "selection", ())]
    if model.rule is not None and terms:
        model = keep_terms(model, terms)
    substeps = getattr(found, "substeps", None)
    if substeps is not None and substeps != model.solver.substeps:
        model = replace_substeps(model, substeps)
    model = replace_starts(model, getattr(found, "initial", None))
    held = tuple(
        replace(channel, hold=found.holds.get(channel.name, "auto"))
        if channel.hold == "auto"
        else channel
        for channel in inputs
    )
    others = re.compile(r".*\(0\)\[\d+\]")
    kept = {k: v for k, v in numbers.items() if not (others.fullmatch(k) or is_noise_parameter(k))}
    return model, held, kept


def _choose_times(inputs: tuple[Channel, ...], times: ArrayLike | None) -> TimeAxis:
    """Choose the times of the outputs, on the clock of the inputs if they have one."""
    if times is None and not inputs:
        raise InvalidSettings("/times", "the model has no input; give the times of the outputs")
    start = inputs[0].started_at if inputs else None
    if times is None:
        axis = TimeAxis(inputs[0].times, start)
    else:
        at, first, _ = read_times(times, "the times")
        if first is not None and start is not None:
            at = at + measure_distance(first, start)
        axis = TimeAxis(at, start if inputs else first)
    if axis.seconds.ndim != 1 or axis.seconds.size < 2:
        raise InvalidRecord(f"times have shape {axis.seconds.shape}. Need two times or more")
    return axis


def complete_values(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """Add the values of fixed and tied parameters that are missing."""
    fixed = {
        parameter.name: parameter.fixed
        for parameter in model.parameters
        if parameter.fixed is not None
    }
    available = {**fixed, **values}
    free = [replace(p, tied=None) if p.name in available else p for p in model.parameters]
    ties = {name: value_of(tie, available) for name, tie in resolve_ties(model, free).items()}
    return {**ties, **available}


def check_values(model: Model, values: Mapping[str, float]) -> None:
    """Check that all free parameters have values, and that names and numbers are right.

    Raises
    ------
    InvalidSettings
        With the pointer of the first one that is not.
    """
    names = [parameter.name for parameter in model.parameters]
    free = [parameter.name for parameter in model.parameters if parameter.is_free]
    starts = [name_initial_state(state.name, 0) for state in model.states]
    numbers: Mapping[str, object] = values
    for name, value in numbers.items():
        if name not in names and name not in starts:
            raise InvalidSettings(
                f"/parameters/{name}",
                f"the model has no parameter {name!r}{suggest_name(name, [*names, *starts])}",
            )
        if not isinstance(value, int | float | np.number) or not isfinite(value):
            raise InvalidSettings(f"/parameters/{name}", f"{value!r} is not a finite number")
    for name in free:
        if name not in values:
            raise InvalidSettings(f"/parameters/{name}", "a value is missing")


def _fix_parameter(parameter: Parameter, value: float) -> Parameter:
    """Fix a parameter at a value, which may lie outside its bounds."""
    value = float(value)
    lower, upper = min(parameter.lower, value), max(parameter.upper, value)
    return replace(parameter, lower=lower, upper=upper, fixed=value, scale="linear", tied=None)


def _fix_initial(
    start: InitialState, state: str, values: Mapping[str, float], *, is_measured: bool
) -> InitialState:
    name = name_initial_state(state, 0)
    if name in values:
        return FixedInitial(float(values[name]))
    if isinstance(start, FixedInitial | DerivedInitial):
        return start
    if isinstance(start, MeasuredInitial) and is_measured:
        return start
    raise InvalidSettings(
        f"/parameters/{name}", f"a value is missing. The model does not fix where {state!r} starts"
    )
