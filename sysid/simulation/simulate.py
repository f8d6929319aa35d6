"""Free run of a model with known parameters: inputs in, outputs out."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite

import numpy as np

from sysid.core.errors import InvalidRecord, InvalidSettings, suggest_name
from sysid.core.types import FloatArray
from sysid.data.records import Channel, Record, Recording
from sysid.language.evaluation import evaluate_expression as value_of
from sysid.models.model import FixedInitial, InitialState, Model, name_initial_state
from sysid.models.parameters import Parameter
from sysid.models.ties import resolve_ties
from sysid.simulation.problem import build_simulation_problem


def simulate(
    model: Model, inputs: Sequence[Channel], values: Mapping[str, float], *, times: FloatArray
) -> Recording:
    """Outputs of a model at given times.

    Parameters
    ----------
    model : Model
    inputs : sequence of Channel
        One for each input of the model, of the same name; others are ignored.
    values : mapping of str to float
        Every parameter, inside or outside its bounds, and initial values such as ``x(0)`` where
        the model does not fix them (where it does, they replace its own). One that the model fixes
        or ties to others may be left out.
    times : FloatArray, shape (N,)
        Seconds, not decreasing; regular for a difference equation, whose period they give.

    Returns
    -------
    Recording
        One channel for each output, ``inf`` or ``nan`` where the simulation diverged.

    Raises
    ------
    InvalidSettings
        If a value is missing, unknown or not finite.
    InvalidRecord, RecordTooShort
        If an input is missing or the times are too short for the model's lags.
    """
    _check_values(model, values)
    values = complete_values(model, values)
    known = tuple(
        _fix_parameter(parameter, values[parameter.name]) for parameter in model.parameters
    )
    initial = tuple(
        _fix_initial(start, state.name, values)
        for start, state in zip(model.initial, model.states, strict=True)
    )
    if times.ndim != 1 or times.size < 2:
        raise InvalidRecord(f"times have shape {times.shape}; need two times or more")
    missing = np.full(times.size, np.nan)
    outputs = tuple(Channel(o.name, times, missing, o.unit) for o in model.outputs)
    problem = build_simulation_problem(
        replace(model, parameters=known, initial=initial), Record(tuple(inputs), outputs)
    )
    found = problem.split_by_output(problem.predict(np.empty((1, 0)))[0])[0]
    return Recording(tuple(replace(c, values=found[c.name].copy()) for c in outputs))


def complete_values(model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """The values, and those of fixed and tied parameters that are not among them."""
    fixed = {one.name: one.fixed for one in model.parameters if one.fixed is not None}
    known = {**fixed, **values}
    free = [replace(p, tied=None) if p.name in known else p for p in model.parameters]
    ties = {name: value_of(tie, known) for name, tie in resolve_ties(model, free).items()}
    return {**ties, **known}


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
    """The parameter fixed at a value, which may lie outside its bounds."""
    value = float(value)
    lower, upper = min(parameter.lower, value), max(parameter.upper, value)
    return replace(parameter, lower=lower, upper=upper, fixed=value, scale="linear", tied=None)


def _fix_initial(start: InitialState, state: str, values: Mapping[str, float]) -> FixedInitial:
    name = name_initial_state(state, 0)
    if name in values:
        return FixedInitial(float(values[name]))
    if isinstance(start, FixedInitial):
        return start
    raise InvalidSettings(
        f"/parameters/{name}", f"a value is missing: the model does not fix where {state!r} starts"
    )
