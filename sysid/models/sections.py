"""Sections of a model document that all forms share: names, parameters, initial, solver."""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast, get_args

from sysid.core.errors import InvalidBounds, join_pointer, suggest_name
from sysid.language.checker import SignalUse, check_expression
from sysid.language.scope import EquationForm, Scope, list_reserved_names
from sysid.language.transform import substitute
from sysid.language.tree import Expression, Number, PastValue, Symbol, walk
from sysid.models.document_reader import DocumentReader, quote_value
from sysid.models.model import (
    MAX_SUBSTEPS,
    DerivedInitial,
    EstimatedInitial,
    FixedInitial,
    HistoryKind,
    InitialState,
    InterpolationKind,
    MeasuredInitial,
    ModelForm,
    ModelSignal,
    Solver,
    SolverMethod,
)
from sysid.models.parameters import (
    BoundSide,
    BoundsRule,
    Parameter,
    ParameterScale,
    PhysicalBounds,
)

STEADY = "steady"
"""A start at which the equations rest with the inputs' first values."""

AUTO = "auto"
"""Starts that the document leaves open: they are estimated, and compared with a rest."""

HISTORY = "history"
"""A start at which the history function of the state ends."""

OPEN_START = EstimatedInitial(-10.0, 10.0, "state")
"""Estimated start whose bounds follow the data; without data they are these."""

MAX_EQUATIONS = 64
MAX_PARAMETERS = 256

_NAME = re.compile(r"[^\W\d]\w{0,63}")
_PARAMETER_FIELDS = (
    "lower",
    "upper",
    "bounds",
    "unit",
    "scale",
    "fixed",
    "tied",
    "physical",
    "description",
)
_NEED_START = (
    "need a number, {lower, upper} to estimate it, measured, steady, or an expression of "
    "parameters and first input values, such as K*u0"
)
_SOLVER_FIELDS = ("method", "step", "substeps", "history", "interpolation")
_DIFFERENTIAL_FIELDS = ("method", "step")


def check_names(
    reader: DocumentReader, form: EquationForm, sections: Mapping[str, Sequence[str]]
) -> None:
    """Add a fault for every name that is invalid, reserved, or declared twice."""
    taken: dict[str, str] = {}
    words = list_reserved_names(form)
    for section, names in sections.items():
        for name in names:
            pointer = join_pointer(section, name)
            if not _NAME.fullmatch(name):
                need = "need letters, digits and _, not starting with a digit, at most 64 of them"
                reader.add_fault(pointer, f"{quote_value(name)} cannot be a name; {need}")
            elif name in words:
                reader.add_fault(
                    pointer, f"{name!r} is a word of the language; choose another name"
                )
            elif name in taken:
                reader.add_fault(pointer, f"{name!r} is already declared in /{taken[name]}")
            taken.setdefault(name, section)


def read_signals(reader: DocumentReader, value: object, pointer: str) -> tuple[ModelSignal, ...]:
    """Read signals with their units: ``{q: N}``."""
    fields = reader.read_section(value, pointer, most=MAX_EQUATIONS)
    return tuple(
        ModelSignal(k, reader.read_unit(v, pointer + join_pointer(k))) for k, v in fields.items()
    )


def read_constants(reader: DocumentReader, value: object) -> dict[str, float]:
    """Read constants: ``{m: 1.0}``."""
    fields = reader.read_section(value, "/constants")
    return {k: reader.read_number(v, join_pointer("constants", k)) for k, v in fields.items()}


def read_parameters(reader: DocumentReader, value: object) -> tuple[Parameter, ...]:
    """Read parameters; those with faults are left out."""
    fields = reader.read_section(value, "/parameters", most=MAX_PARAMETERS)
    parameters = (_read_parameter(reader, name, entry) for name, entry in fields.items())
    return tuple(parameter for parameter in parameters if parameter is not None)


def _read_parameter(reader: DocumentReader, name: str, entry: object) -> Parameter | None:
    pointer, faults_before = join_pointer("parameters", name), reader.count_faults()
    fields = reader.read_section(entry, pointer, _PARAMETER_FIELDS)
    if isinstance(entry, Mapping) or entry is None:
        for bound in ("lower", "upper"):
            reader.require_field(fields, bound, pointer, "give the interval in which to search")
    numbers = {
        key: reader.read_number(fields[key], pointer + join_pointer(key))
        for key in ("lower", "upper", "fixed")
        if fields.get(key) is not None
    }
    unit = reader.read_unit(fields.get("unit"), pointer + "/unit")
    scale = reader.read_choice(
        fields.get("scale", "linear"), get_args(ParameterScale), pointer + "/scale"
    )
    reader.read_text(fields.get("description"), pointer + "/description")
    tied = reader.read_text(fields.get("tied"), pointer + "/tied") or None
    if tied is not None and "fixed" in numbers:
        reader.add_fault(
            pointer + "/tied", "a parameter is either fixed or tied; leave one of them out"
        )
    bounds = _read_bounds_rule(reader, fields, pointer)
    physical = _read_physical_bounds(reader, fields, pointer)
    if reader.count_faults() > faults_before:
        return None
    try:
        parameter = Parameter(
            name,
            unit=unit,
            scale=cast(ParameterScale, scale),
            tied=tied,
            bounds=bounds,
            physical=physical,
            **numbers,
        )
    except InvalidBounds as error:
        reader.add_fault(pointer, str(error))
        return None
    for side in get_args(BoundSide):
        if parameter.is_physical(side) and parameter.follows_data(side):
            reader.add_fault(
                pointer + "/physical",
                f"the {side} bound follows the data, so it is no physical limit; leave out "
                "'bounds' or 'physical'",
            )
    return parameter


def _read_bounds_rule(
    reader: DocumentReader, fields: Mapping[str, Any], pointer: str
) -> BoundsRule | None:
    """Read what a parameter is, if its bounds follow the data."""
    if fields.get("bounds") is None:
        return None
    rule = reader.read_choice(fields["bounds"], get_args(BoundsRule), pointer + "/bounds")
    return cast(BoundsRule, rule)


def _read_physical_bounds(
    reader: DocumentReader, fields: Mapping[str, Any], pointer: str
) -> PhysicalBounds | None:
    """Read which bounds are limits of the quantity itself."""
    if fields.get("physical") is None:
        return None
    sides = reader.read_choice(fields["physical"], get_args(PhysicalBounds), pointer + "/physical")
    return cast(PhysicalBounds, sides)


def get_interval(parameter: Parameter) -> tuple[float, float]:
    """Return the interval of a parameter: its bounds, or twice its fixed value."""
    if parameter.fixed is not None:
        return (parameter.fixed, parameter.fixed)
    return (parameter.lower, parameter.upper)


def read_initial_states(
    reader: DocumentReader,
    value: object,
    scope: Scope,
    default: InitialState,
    with_history: Collection[str] = (),
) -> tuple[InitialState, ...]:
    """Read the initial value of each state.

    The expressions of starts that are steady, or follow from a history, are still open. The latter
    is the default of a state `with_history`.
    """
    states = scope.states
    if value == AUTO:
        fields: Mapping[str, Any] = {}
        default = OPEN_START if scope.form == "differential" else default
    elif value == STEADY:
        fields = dict.fromkeys(states, STEADY)
    else:
        fields = reader.read_section(value, "/initial")
    for name in fields:
        if name not in states:
            reader.add_fault(
                join_pointer("initial", name), f"there is no such state{suggest_name(name, states)}"
            )
    return tuple(
        _read_initial_state(reader, fields[name], join_pointer("initial", name), scope)
        if name in fields
        else (DerivedInitial(Number(0.0), HISTORY) if name in with_history else default)
        for name in states
    )


def _read_initial_state(
    reader: DocumentReader, value: object, pointer: str, scope: Scope
) -> InitialState:
    if value == "measured":
        return MeasuredInitial()
    if isinstance(value, str):
        text = " ".join(value.split())
        return DerivedInitial(
            Number(0.0) if text in (STEADY, HISTORY) else _read_start(reader, text, pointer, scope),
            text,
        )
    if isinstance(value, Mapping):
        fields = reader.read_section(value, pointer, ("lower", "upper", "bounds"))
        for bound in ("lower", "upper"):
            reader.require_field(
                fields, bound, pointer, "an estimated initial state needs both bounds"
            )
        lower, upper = (
            reader.read_number(fields.get(b) or 0.0, pointer) for b in ("lower", "upper")
        )
        if {"lower", "upper"} <= fields.keys() and not lower < upper:
            reader.add_fault(pointer, f"has bounds [{lower:g}, {upper:g}]; need lower < upper")
        return EstimatedInitial(lower, upper, _read_bounds_rule(reader, fields, pointer))
    if isinstance(value, bool) or not isinstance(value, int | float):
        reader.add_fault(pointer, f"{quote_value(value)} is not an initial state; {_NEED_START}")
        return FixedInitial(0.0)
    return FixedInitial(reader.read_number(value, pointer))


def _read_start(reader: DocumentReader, text: str, pointer: str, scope: Scope) -> Expression:
    """Read the expression of a start; an input u has its first value, which is also ``u0``."""
    declared = (*scope.names, *scope.states)
    first_values = {f"{name}0": name for name in scope.inputs if f"{name}0" not in declared}
    inputs = (*scope.inputs, *first_values)
    if _NAME.fullmatch(text) and text not in (*scope.names, *inputs):
        reader.add_fault(pointer, f"{quote_value(text)} is not an initial state; {_NEED_START}")
        return Number(0.0)
    checked = check_expression(text, replace(scope, states=(), inputs=inputs))
    for column, detail in checked.faults:
        reader.add_fault(pointer, detail, column)
    _check_start_uses(reader, checked.uses, pointer)
    tree = checked.tree or Number(0.0)
    for node in walk(tree):
        if isinstance(node, Symbol) and node.kind in ("time", "index"):
            reader.add_fault(pointer, f"a start does not depend on {node.name}")

    def find_input(node: Expression) -> Expression | None:
        is_first = isinstance(node, PastValue) and node.name in first_values
        return PastValue(first_values[node.name], "input") if is_first else None  # type: ignore[union-attr]

    return substitute(tree, find_input)


def _check_start_uses(reader: DocumentReader, uses: Sequence[SignalUse], pointer: str) -> None:
    """Check that a start reads first values of inputs only; intermediate names may read others."""
    for value, column in uses:
        if value.kind == "state":
            detail = f"a start does not depend on a state such as {value.name!r}"
            reader.add_fault(pointer, detail, column)
        elif value.offset or value.delay is not None:
            detail = f"a start has no past; write {value.name.removesuffix('0')}0, its first value"
            reader.add_fault(pointer, detail, column)


def read_solver(reader: DocumentReader, value: object, form: ModelForm) -> Solver:
    """Read the integration method and how past values are read.

    A difference equation may take several steps in a sampling period (`substeps`). A polynomial
    may not, because its terms are samples.
    """
    fields = reader.read_section(value, "/solver", _SOLVER_FIELDS)
    for name in (name for name in _list_foreign_fields(form) if name in fields):
        detail = "belongs to the differential form; a difference equation steps by samples"
        if name == "substeps":
            detail = "has no effect on a polynomial, whose terms are samples"
        reader.add_fault(join_pointer("solver", name), detail)
    method = fields.get("method", Solver().method)
    is_runge_kutta = form == "differential" and method == "rk4"
    defaults = Solver(interpolation="cubic" if is_runge_kutta else "linear")
    choices: dict[str, Any] = {
        name: reader.read_choice(
            fields.get(name, getattr(defaults, name)), options, "/solver/" + name
        )
        for name, options in (
            ("method", get_args(SolverMethod)),
            ("history", get_args(HistoryKind)),
            ("interpolation", get_args(InterpolationKind)),
        )
    }
    substeps = reader.read_whole_number(
        fields.get("substeps", 1), "/solver/substeps", 1, MAX_SUBSTEPS
    )
    step = _read_step(reader, fields.get("step", "sample"))
    return Solver(step=step, substeps=substeps, **choices)


def _list_foreign_fields(form: ModelForm) -> tuple[str, ...]:
    """List the solver fields that do not apply to this form."""
    fields = {"difference": _DIFFERENTIAL_FIELDS, "polynomial": (*_DIFFERENTIAL_FIELDS, "substeps")}
    return fields.get(form, ())


def _read_step(reader: DocumentReader, value: object) -> float | None:
    if value == "sample":
        return None
    if isinstance(value, str):
        reader.add_fault(
            "/solver/step", f"{quote_value(value)} is not 'sample' or a number of seconds"
        )
        return None
    step = reader.read_number(value, "/solver/step", 1.0)
    if step <= 0:
        reader.add_fault("/solver/step", f"is {step:g} s; need more than 0")
    return step
