"""The parts of a model document that every form has: names, parameters, start and solver."""

import re
from collections.abc import Mapping, Sequence
from typing import Any, cast, get_args

from sysid.core.errors import InvalidBounds, join_pointer, nearest
from sysid.language.scope import Timing, reserved
from sysid.models.documents import Reader, shown
from sysid.models.model import (
    EstimatedInitial,
    FixedInitial,
    Form,
    History,
    Initial,
    Interpolation,
    MeasuredInitial,
    Method,
    Quantity,
    Solver,
)
from sysid.models.parameters import Parameter, Scale

MAX_EQUATIONS = 64
MAX_PARAMETERS = 256

_NAME = re.compile(r"[^\W\d]\w{0,63}")
_PARAMETER_FIELDS = ("lower", "upper", "unit", "scale", "fixed", "tied", "description")
_SOLVER_FIELDS = ("method", "step", "substeps", "history", "interpolation")
_DIFFERENTIAL_FIELDS = ("method", "step")


def check_names(reader: Reader, form: Timing, sections: Mapping[str, Sequence[str]]) -> None:
    """Fault every name that is not one, is taken by the language, or is declared twice."""
    taken: dict[str, str] = {}
    words = reserved(form)
    for section, names in sections.items():
        for name in names:
            place = join_pointer(section, name)
            if not _NAME.fullmatch(name):
                need = "need letters, digits and _, not starting with a digit, at most 64 of them"
                reader.fault(place, f"{shown(name)} cannot be a name; {need}")
            elif name in words:
                reader.fault(place, f"{name!r} is a word of the language; choose another name")
            elif name in taken:
                reader.fault(place, f"{name!r} is already declared in /{taken[name]}")
            taken.setdefault(name, section)


def signals(reader: Reader, value: object, place: str) -> tuple[Quantity, ...]:
    """Signals with their units: ``{q: N}``."""
    fields = reader.section(value, place, most=MAX_EQUATIONS)
    return tuple(Quantity(k, reader.unit(v, place + join_pointer(k))) for k, v in fields.items())


def constants(reader: Reader, value: object) -> dict[str, float]:
    """Known numbers: ``{m: 1.0}``."""
    fields = reader.section(value, "/constants")
    return {k: reader.number(v, join_pointer("constants", k)) for k, v in fields.items()}


def parameters(reader: Reader, value: object) -> tuple[Parameter, ...]:
    """Parameters; one with faults is left out."""
    fields = reader.section(value, "/parameters", most=MAX_PARAMETERS)
    found = (_parameter(reader, name, entry) for name, entry in fields.items())
    return tuple(parameter for parameter in found if parameter is not None)


def _parameter(reader: Reader, name: str, entry: object) -> Parameter | None:
    place, known = join_pointer("parameters", name), reader.count()
    fields = reader.section(entry, place, _PARAMETER_FIELDS)
    if isinstance(entry, Mapping) or entry is None:
        for bound in ("lower", "upper"):
            reader.required(fields, bound, place, "give the interval in which to search")
    numbers = {
        key: reader.number(fields[key], place + join_pointer(key))
        for key in ("lower", "upper", "fixed")
        if fields.get(key) is not None
    }
    unit = reader.unit(fields.get("unit"), place + "/unit")
    scale = reader.choice(fields.get("scale", "linear"), get_args(Scale), place + "/scale")
    reader.text(fields.get("description"), place + "/description")
    tied = reader.text(fields.get("tied"), place + "/tied") or None
    if tied is not None and "fixed" in numbers:
        reader.fault(place + "/tied", "a parameter is either fixed or tied; leave one of them out")
    if reader.count() > known:
        return None
    try:
        return Parameter(name, unit=unit, scale=cast(Scale, scale), tied=tied, **numbers)
    except InvalidBounds as error:
        reader.fault(place, str(error))
        return None


def interval(parameter: Parameter) -> tuple[float, float]:
    """Values a parameter can take: its bounds, or the one value at which it is fixed."""
    if parameter.fixed is not None:
        return (parameter.fixed, parameter.fixed)
    return (parameter.lower, parameter.upper)


def initial(
    reader: Reader, value: object, states: Sequence[str], default: Initial
) -> tuple[Initial, ...]:
    """How each state starts."""
    fields = reader.section(value, "/initial")
    for name in fields:
        if name not in states:
            reader.fault(
                join_pointer("initial", name), f"there is no such state{nearest(name, states)}"
            )
    return tuple(
        _initial(reader, fields[name], join_pointer("initial", name)) if name in fields else default
        for name in states
    )


def _initial(reader: Reader, value: object, place: str) -> Initial:
    if value == "measured":
        return MeasuredInitial()
    if isinstance(value, Mapping):
        fields = reader.section(value, place, ("lower", "upper"))
        for bound in ("lower", "upper"):
            reader.required(fields, bound, place, "an estimated start needs both bounds")
        lower, upper = (reader.number(fields.get(b) or 0.0, place) for b in ("lower", "upper"))
        if len(fields) == 2 and not lower < upper:
            reader.fault(place, f"has bounds [{lower:g}, {upper:g}]; need lower < upper")
        return EstimatedInitial(lower, upper)
    if isinstance(value, bool) or not isinstance(value, int | float):
        need = "need a number, {lower, upper} to estimate it, or measured"
        reader.fault(place, f"{shown(value)} is no start of a state; {need}")
        return FixedInitial(0.0)
    return FixedInitial(reader.number(value, place))


def solver(reader: Reader, value: object, form: Form) -> Solver:
    """How the model is integrated and how past values are read.

    A difference equation may take several steps in a sampling period (`substeps`); the terms of
    a polynomial are samples, so it may not.
    """
    fields = reader.section(value, "/solver", _SOLVER_FIELDS)
    for name in (name for name in _foreign(form) if name in fields):
        detail = "belongs to the differential form; a difference equation steps by samples"
        if name == "substeps":
            detail = "is of no use to a polynomial, whose terms are samples"
        reader.fault(join_pointer("solver", name), detail)
    plain = Solver()
    choices: dict[str, Any] = {
        name: reader.choice(fields.get(name, getattr(plain, name)), options, "/solver/" + name)
        for name, options in (
            ("method", get_args(Method)),
            ("history", get_args(History)),
            ("interpolation", get_args(Interpolation)),
        )
    }
    substeps = reader.whole(fields.get("substeps", 1), "/solver/substeps", 1, 1000)
    step = _step(reader, fields.get("step", "sample"))
    return Solver(step=step, substeps=substeps, **choices)


def _foreign(form: Form) -> tuple[str, ...]:
    """Fields of a solver that mean nothing in this form."""
    fields = {"difference": _DIFFERENTIAL_FIELDS, "polynomial": (*_DIFFERENTIAL_FIELDS, "substeps")}
    return fields.get(form, ())


def _step(reader: Reader, value: object) -> float | None:
    if value == "sample":
        return None
    if isinstance(value, str):
        reader.fault("/solver/step", f"{shown(value)} is not 'sample' or a number of seconds")
        return None
    step = reader.number(value, "/solver/step", 1.0)
    if step <= 0:
        reader.fault("/solver/step", f"is {step:g} s; need more than 0")
    return step
