"""Simulation of a model with given parameter values."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite

import numpy as np

from sysid.core.errors import InvalidRecord, InvalidSettings, suggest_name
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record, Recording
from sysid.language.evaluation import evaluate_expression as value_of
from sysid.models.model import DerivedInitial, FixedInitial, InitialState, Model, name_initial_state
from sysid.models.parameters import Parameter
from sysid.models.ties import resolve_ties
from sysid.simulation.problem import build_simulation_problem


def simulate(
    model: Model, inputs: Sequence[Channel], values: Mapping[str, float], *, times: FloatArray
) -> Recording:
    """Simulate the outputs of a model at some times.

    Parameters
    ----------
    model : Model
    inputs : sequence of Channel
        One for each input of the model, of the same name; others are ignored.
    values : mapping of str to float
        Every parameter, inside or outside its bounds, and initial values such as ``x(0)``. Initial
        values that the model fixes are optional and replace its own. Parameters that the model
        fixes or ties to others are optional.
    times : FloatArray, shape (N,)
        Seconds, not decreasing. For a difference equation they are regular and set its period.

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
    """
    _check_values(model, values)
    values = complete_values(model, values)
    fixed_parameters = tuple(
        _fix_parameter(parameter, values[parameter.name]) for parameter in model.parameters
    )
    initial = tuple(
        _fix_initial(start, state.name, values)
        for start, state in zip(model.initial, model.states, strict=True)
    )
    if times.ndim != 1 or times.size < 2:
        raise InvalidRecord(f"times have shape {times.shape}. Need two times or more")
    missing = np.full(times.size, np.nan)
    outputs = tuple(Channel(o.name, times, missing, o.unit) for o in model.outputs)
    problem = build_simulation_problem(
        replace(model, parameters=fixed_parameters, initial=initial), Record(tuple(inputs), outputs)
    )
    simulated = problem.split_by_output(problem.predict(np.empty((1, 0)))[0])[0]
    return Recording(tuple(replace(c, values=simulated[c.name].copy()) for c in outputs))


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


def _check_values(model: Model, values: Mapping[str, float]) -> None:
    names = [parameter.name for parameter in model.parameters]
    free = [parameter.name for parameter in model.parameters if parameter.is_free]
    starts = [name_initial_state(state.name, 0) for state in model.states]
    for name, value in values.items():
        if name not in names and name not in starts:
            raise InvalidSettings(
                f"/parameters/{name}",
                f"the model has no parameter {name!r}{suggest_name(name, [*names, *starts])}",
            )
        if not isfinite(value):
            raise InvalidSettings(f"/parameters/{name}", f"{value!r} is not a finite number")
    for name in free:
        if name not in values:
            raise InvalidSettings(f"/parameters/{name}", "a value is missing")


def _fix_parameter(parameter: Parameter, value: float) -> Parameter:
    """Fix a parameter at a value, which may lie outside its bounds."""
    value = float(value)
    lower, upper = min(parameter.lower, value), max(parameter.upper, value)
    return replace(parameter, lower=lower, upper=upper, fixed=value, scale="linear", tied=None)


def _fix_initial(start: InitialState, state: str, values: Mapping[str, float]) -> InitialState:
    name = name_initial_state(state, 0)
    if name in values:
        return FixedInitial(float(values[name]))
    if isinstance(start, FixedInitial | DerivedInitial):
        return start
    raise InvalidSettings(
        f"/parameters/{name}", f"a value is missing. The model does not fix where {state!r} starts"
    )
