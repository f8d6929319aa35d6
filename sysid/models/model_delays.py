"""Checks of a request: delays must be causal and fit into the record; settings must be used.

A setting without effect is refused, since it is usually a mistake.
"""

from collections.abc import Mapping, Sequence
from math import inf

from sysid.core.errors import Fault, InvalidRecord, InvalidSettings, RecordTooShort
from sysid.core.settings import Weights
from sysid.core.units import format_unit
from sysid.language.delays import collect_past_values, has_varying_delay
from sysid.language.functions import Interval
from sysid.language.printer import format_expression
from sysid.language.tree import Expression, PastValue
from sysid.language.value_intervals import bound_expression
from sysid.models.kalman_filter import is_noise_parameter
from sysid.models.model import DerivedInitial, Model, build_initial_parameters
from sysid.models.parameters import Parameter, override_parameters
from sysid.models.sections import get_interval
from sysid.models.ties import apply_ties, collect_parameter_names, resolve_ties

_HALVINGS = 60  # bisections for the value of a parameter that a record allows
_FAR_FACTOR = 1e6  # of a fixed value, up to which a larger one is tried
_BOUNDS = ("lower", "upper")


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
        if value.delay is None or has_varying_delay(value):
            continue  # a varying delay is checked with the record
        low = bound_expression(value.delay, ends, period)[0]
        if low < 0:
            smallest = f"{low + value.offset:g} {unit}"
            raise InvalidSettings(
                "/parameters",
                f"inside these bounds the delay of {format_expression(value, clock)} can be as "
                f"small as {smallest}; the model needs {value.offset} {unit} or more",
            )


def list_trees(model: Model) -> list[Expression]:
    """List the expressions of equations, outputs, starts and histories."""
    outputs = [output.expression for output in model.outputs]
    starts = [start.expression for start in model.initial if isinstance(start, DerivedInitial)]
    histories = [history.expression for history in model.histories]
    return [*model.equations, *outputs, *starts, *histories]


def list_past_values(model: Model) -> list[PastValue]:
    """List every past value that an equation or an output reads."""
    trees = (*model.equations, *(output.expression for output in model.outputs))
    return [value for tree in trees for value in collect_past_values(tree)]


def has_known_past(model: Model, past: PastValue) -> bool:
    """Whether a value before the start follows from a history function, however long ago."""
    return past.kind == "state" and model.find_history(past.name) is not None


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

    The past of a state with a history function is known.

    Parameters
    ----------
    spans : mapping of str to (lower, upper)
        Interval of every parameter; a fixed one has two equal ends. Also the range of every
        input that a delay reads.
    step, duration : float
        Integration step and length of the record, in s.

    Raises
    ------
    InvalidRecord
        If a delay that changes with inputs can be negative or unlimited in the record.
    RecordTooShort
        If so; the message names the parameters of the delay, their bounds and a value that is
        short enough.
    """
    if has_known_past(model, past):
        return
    longest = compute_longest_delay(model, past, spans, step)
    if has_varying_delay(past):
        _check_varying_delay(model, past, spans, step)
    if longest < duration:
        return
    names = (
        sorted(collect_parameter_names(past.delay) & set(spans)) if past.delay is not None else []
    )
    units = {parameter.name: parameter.unit for parameter in model.parameters}
    ends = [_find_longest_end(model, past, spans, step, name) for name in names]
    reasons = [
        _describe_bound(name, spans[name], end, units.get(name, "1"))
        for name, end in zip(names, ends, strict=True)
    ]
    cure = "a longer record"
    if len(names) == 1:
        limit = _find_limit(model, past, spans, step, duration, ends[0])
        unit = format_unit(units.get(names[0], "1"))
        bound = "" if _is_fixed(spans[names[0]]) else f"{_BOUNDS[ends[0]]} bound of "
        direction, side = ("smaller", "below") if ends[0] else ("larger", "above")
        if limit is not None:
            cure += f", or a {direction} {bound}{names[0]}: {side} {limit:.4g}{unit}"
    elif names:
        cure += ", or smaller bounds" if all(ends) else ", or narrower bounds"
    reasons += _describe_ranges(past, spans)
    what = f"the delay of {past.name!r}"
    raise RecordTooShort(duration, longest, what, " and ".join(reasons), cure)


def _check_varying_delay(
    model: Model, past: PastValue, spans: Mapping[str, Interval], step: float
) -> None:
    """Check that a delay that changes with inputs is neither negative nor unlimited."""
    if past.delay is None:
        return
    low, high = bound_expression(past.delay, spans, step)
    if low >= 0 and high < inf:
        return
    kind = "be negative" if low < 0 else "grow without limit"
    name = next(value.name for value in collect_past_values(past.delay))
    raise InvalidRecord(
        f"the lag of {format_expression(past, 't' if model.form == 'differential' else 'k')} can "
        f"{kind}, because {' and '.join(_describe_ranges(past, spans))}. Limit it in the model, "
        f"such as by max({name}, …), or leave that part of the record out."
    )


def _describe_ranges(past: PastValue, spans: Mapping[str, Interval]) -> list[str]:
    """Describe the ranges of the inputs that a delay reads."""
    names = {} if past.delay is None else {v.name: 0 for v in collect_past_values(past.delay)}
    ranges = {name: spans[name] for name in names if name in spans}
    return [f"{name} goes from {a:.4g} to {b:.4g} in the record" for name, (a, b) in ranges.items()]


def _find_longest_end(
    model: Model, past: PastValue, spans: Mapping[str, Interval], step: float, name: str
) -> int:
    """Find which end of a parameter's interval the longest delay has: 0 lower, 1 upper.

    A lag V/F is longest at the lower end of F. A fixed value counts by what a larger one does.
    """
    lower, upper = spans[name]
    upper = upper if upper > lower else lower + 0.5 * abs(lower) + 1e-9
    low, high = (
        compute_longest_delay(model, past, {**spans, name: (value, value)}, step)
        for value in (lower, upper)
    )
    return int(high >= low)


def _describe_bound(name: str, span: Interval, end: int, unit: str) -> str:
    value = f"{span[end]:.6g}{format_unit(unit)}"
    return (
        f"{name} is {value}"
        if _is_fixed(span)
        else f"the {_BOUNDS[end]} bound of {name} is {value}"
    )


def _is_fixed(span: Interval) -> bool:
    return span[0] == span[1]


def _find_limit(
    model: Model,
    past: PastValue,
    spans: Mapping[str, Interval],
    step: float,
    duration: float,
    end: int,
) -> float | None:
    """Find where the delay's only parameter gets too long at this end of its interval, or None."""
    [name] = collect_parameter_names(past.delay) & set(spans) if past.delay is not None else []
    fitting, too_long = spans[name][1 - end], spans[name][end]
    if _is_fixed(spans[name]):
        fitting = min(too_long, 0.0) if end else _FAR_FACTOR * abs(too_long)

    def fits(value: float) -> bool:
        ends = (min(fitting, value), max(fitting, value))
        return compute_longest_delay(model, past, {**spans, name: ends}, step) < duration

    if not fits(fitting):
        return None
    for _ in range(_HALVINGS):
        middle = 0.5 * (fitting + too_long)
        fitting, too_long = (middle, too_long) if fits(middle) else (fitting, middle)
    return too_long


def find_unused_settings(
    model: Model, parameters: Sequence[Parameter], weights: Weights | None
) -> list[Fault]:
    """Find free parameters that no expression reads, and one weight on the only output.

    Parameters
    ----------
    model : Model
        With its ties applied.
    parameters : sequence of Parameter
        The model's own, without initial states.
    """
    read = {name for tree in list_trees(model) for name in collect_parameter_names(tree)}
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
    if len(outputs) == 1 and isinstance((weights or {}).get(outputs[0]), int | float):
        detail = (
            f"{outputs[0]!r} is the model's only output, so a weight would change nothing; "
            "leave it out, or give one for each experiment"
        )
        faults.append(Fault(f"/weights/{outputs[0]}", detail))
    return faults


def check_unused_settings(
    model: Model,
    experiments: int,
    changes: Mapping[str, Mapping[str, object]] | None,
    weights: Weights | None,
) -> None:
    """Raise for the first unused setting (see `find_unused_settings`).

    Raises
    ------
    InvalidSettings, InvalidBounds
        With the pointer of the setting; also if the changes of parameters are invalid.
    """
    own = {k: one for k, one in (changes or {}).items() if not is_noise_parameter(k)}  # no filter's
    overridden = override_parameters(
        (*model.parameters, *build_initial_parameters(model, experiments)), own
    )
    tied = apply_ties(model, resolve_ties(model, overridden))
    for fault in find_unused_settings(tied, overridden[: len(model.parameters)], weights):
        raise InvalidSettings(fault.pointer, fault.detail)
