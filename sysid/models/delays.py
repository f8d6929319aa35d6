"""Checks of a request: delays must be causal and fit into the record; settings must be used.

A setting without effect is refused, since it is usually a mistake.
"""

from collections.abc import Mapping, Sequence

from sysid.core.errors import Fault, InvalidSettings, RecordTooShort
from sysid.core.units import format_unit
from sysid.language.delays import collect_past_values
from sysid.language.functions import Interval
from sysid.language.intervals import bound_expression
from sysid.language.printer import format_expression
from sysid.language.tree import PastValue
from sysid.models.model import Model, build_initial_parameters
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.sections import get_interval
from sysid.models.ties import apply_ties, collect_parameter_names, resolve_ties

_HALVINGS = 60  # bisections for the largest value of a parameter that a record allows


def check_delays(
    model: Model, parameters: Sequence[Parameter], period: float | None = None
) -> None:
    """Raise if a delay could be negative inside these bounds.

    Parameters
    ----------
    model : Model
    parameters : sequence of Parameter
        The model's parameters, with the bounds and fixed values of a request.
    period : float or None
        Sampling period in s, if it is known.

    Raises
    ------
    InvalidSettings
        If so; the message names the past value and the smallest delay.
    """
    ends = {parameter.name: get_interval(parameter) for parameter in parameters}
    clock = "t" if model.form == "differential" else "k"
    unit = "s" if model.form == "differential" else "samples"
    for value in list_past_values(model):
        low = bound_expression(value.delay, ends, period)[0] if value.delay is not None else 0.0
        if low < 0:
            smallest = f"{low + value.offset:g} {unit}"
            raise InvalidSettings(
                "/parameters",
                f"inside these bounds the delay of {format_expression(value, clock)} can be as "
                f"small as {smallest}; the model needs {value.offset} {unit} or more",
            )


def list_past_values(model: Model) -> list[PastValue]:
    """List every past value that an equation or an output reads."""
    trees = (*model.equations, *(output.expression for output in model.outputs))
    return [value for tree in trees for value in collect_past_values(tree)]


def compute_longest_delay(
    model: Model, past: PastValue, spans: Mapping[str, Interval], step: float | None
) -> float:
    """Compute the longest delay (s) of a past value inside these bounds; `step` in s."""
    back = past.offset + (
        0.0 if past.delay is None else bound_expression(past.delay, spans, step)[1]
    )
    return back if model.form == "differential" else back * (step or 0.0)


def check_record_length(
    model: Model, past: PastValue, spans: Mapping[str, Interval], step: float, duration: float
) -> None:
    """Raise if a past value may lie further back than the record lasts.

    Parameters
    ----------
    spans : mapping of str to (lower, upper)
        Interval of every parameter; a fixed one has two equal ends.
    step, duration : float
        Integration step and length of the record, in s.

    Raises
    ------
    RecordTooShort
        If so; the message names the parameters of the delay, their bounds and a value that is
        short enough.
    """
    longest = compute_longest_delay(model, past, spans, step)
    if longest < duration:
        return
    names = (
        sorted(collect_parameter_names(past.delay) & set(spans)) if past.delay is not None else []
    )
    units = {parameter.name: parameter.unit for parameter in model.parameters}
    reasons = [_describe_bound(name, spans[name], units.get(name, "1")) for name in names]
    cure = "a longer record"
    if len(names) == 1:
        limit = _find_largest_value(model, past, spans, step, duration)
        unit = format_unit(units.get(names[0], "1"))
        quantity = names[0] if _is_fixed(spans[names[0]]) else f"upper bound of {names[0]}"
        cure += "" if limit is None else f", or a smaller {quantity}: below {limit:.4g}{unit}"
    elif names:
        cure += ", or smaller bounds"
    what = f"the delay of {past.name!r}"
    raise RecordTooShort(duration, longest, what, " and ".join(reasons), cure)


def _describe_bound(name: str, span: Interval, unit: str) -> str:
    value = f"{span[1]:.6g}{format_unit(unit)}"
    return f"{name} is {value}" if _is_fixed(span) else f"the upper bound of {name} is {value}"


def _is_fixed(span: Interval) -> bool:
    return span[0] == span[1]


def _find_largest_value(
    model: Model, past: PastValue, spans: Mapping[str, Interval], step: float, duration: float
) -> float | None:
    """Find the largest value of the delay's only parameter that the record allows, or None."""
    [name] = collect_parameter_names(past.delay) & set(spans) if past.delay is not None else []
    lower, upper = spans[name]
    start = min(lower, 0.0) if _is_fixed(spans[name]) else lower

    def fits(value: float) -> bool:
        return compute_longest_delay(model, past, {**spans, name: (start, value)}, step) < duration

    if not fits(start):
        return None
    low, high = start, upper
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return high


def find_unused_settings(
    model: Model, parameters: Sequence[Parameter], weights: Mapping[str, float] | None
) -> list[Fault]:
    """Find free parameters that no equation reads, and a weight on the only output.

    Parameters
    ----------
    model : Model
        With its ties applied.
    parameters : sequence of Parameter
        The model's own, without initial states.
    """
    trees = (*model.equations, *(output.expression for output in model.outputs))
    read = {name for tree in trees for name in collect_parameter_names(tree)}
    nowhere = "no term" if model.form == "polynomial" else "no equation and no output"
    faults = [
        Fault(
            f"/parameters/{parameter.name}",
            f"{nowhere} of model {model.name!r} uses {parameter.name!r}, so no data can determine "
            "it; remove it from the model, or fix it",
        )
        for parameter in parameters
        if parameter.is_free and parameter.name not in read
    ]
    outputs = [output.name for output in model.outputs]
    if len(outputs) == 1 and outputs[0] in (weights or {}):
        detail = (
            f"{outputs[0]!r} is the model's only output, so a weight would change nothing; "
            "leave it out"
        )
        faults.append(Fault(f"/weights/{outputs[0]}", detail))
    return faults


def check_unused_settings(
    model: Model,
    experiments: int,
    changes: Mapping[str, Mapping[str, object]] | None,
    weights: Mapping[str, float] | None,
) -> None:
    """Raise for the first unused setting (see `find_unused_settings`).

    Raises
    ------
    InvalidSettings, InvalidBounds
        With the pointer of the setting; also if the changes of parameters are invalid.
    """
    overridden = override_parameters(
        (*model.parameters, *build_initial_parameters(model, experiments)), dict(changes or {})
    )
    tied = apply_ties(model, resolve_ties(model, overridden))
    for fault in find_unused_settings(tied, overridden[: len(model.parameters)], weights):
        raise InvalidSettings(fault.pointer, fault.detail)
