"""Parsing of model documents: from YAML or JSON data to a checked `Model`."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

from sysid.core.errors import Fault, InvalidModel, InvalidSettings, join_pointer
from sysid.language.scope import EquationForm, Scope
from sysid.language.tree import Expression, Number, PastValue, match_plain_state
from sysid.models import equations
from sysid.models.document_reader import DocumentReader, quote_value
from sysid.models.histories import derive_starts, read_histories
from sysid.models.intermediates import read_intermediates
from sysid.models.model import (
    DerivedInitial,
    EstimatedInitial,
    FixedInitial,
    InitialState,
    MeasuredInitial,
    Model,
    ModelForm,
    ModelSignal,
    NoisePlaces,
    Output,
)
from sysid.models.noise_places import read_noise
from sysid.models.normal_form import to_normal_form
from sysid.models.parameters import Parameter
from sysid.models.polynomial import POLYNOMIAL_FIELDS as POLYNOMIAL_FIELDS
from sysid.models.polynomial import expand_polynomial
from sysid.models.rest import NoRestError, solve_rest
from sysid.models.sections import (
    STEADY,
    check_names,
    get_interval,
    read_constants,
    read_initial_states,
    read_parameters,
    read_signals,
    read_solver,
)
from sysid.models.ties import resolve_ties
from sysid.models.unit_checks import check_delay_units

_COMMON_FIELDS = (
    "name",
    "title",
    "description",
    "source",
    "form",
    "inputs",
    "parameters",
    "constants",
    "let",
    "initial",
    "history",
    "solver",
    "noise",
)
_FORMS = ("difference", "differential", "polynomial")
_FIELDS = {
    "difference": (*_COMMON_FIELDS, "states", "equations", "outputs"),
    "differential": (*_COMMON_FIELDS, "states", "equations", "outputs"),
    "polynomial": (*_COMMON_FIELDS, *POLYNOMIAL_FIELDS),
}
_PAST_SAMPLE = re.compile(r"\w\(k\s*[-)]")
"""An earlier value in a recursion, such as ``x(k-1)``."""
_MODEL_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def parse_model(document: object) -> Model:
    """Parse a document to a model; all faults are reported at once.

    Parameters
    ----------
    document : object
        A mapping as read from YAML or JSON.

    Raises
    ------
    InvalidModel
        With every fault: its JSON pointer and, inside an equation, its column.
    """
    reader = DocumentReader()
    if not isinstance(document, Mapping):
        raise InvalidModel(
            [Fault("", f"a model is a mapping of fields, not {quote_value(document)}")]
        )
    form = _read_form(reader, document)
    fields = reader.read_section(document, "", _FIELDS[form])
    _read_head(reader, fields)
    model = (
        _read_polynomial_model(reader, fields)
        if form == "polynomial"
        else _read_equation_model(reader, fields, form)
    )
    _check_size(reader, model)
    check_delay_units(reader, model)
    _check_bounds_rules(reader, model)
    reader.raise_faults()
    model = replace(model, document=to_normal_form(fields, model))
    try:
        resolve_ties(model, model.parameters)
    except InvalidSettings as error:
        raise InvalidModel([Fault(error.pointer, error.detail)]) from None
    return model


def keep_terms(model: Model, labels: Sequence[str]) -> Model:
    """Restrict a polynomial to some of its terms (``"1"``: the constant), in this order."""
    listed = [label for label in labels if label != "1"]
    document = {**model.document, "terms": listed, "constant": "1" in labels}
    return parse_model(document)


def _check_size(reader: DocumentReader, model: Model) -> None:
    starts = (start.expression for start in model.initial if isinstance(start, DerivedInitial))
    outputs = (output.expression for output in model.outputs)
    pointer = "/terms" if model.form == "polynomial" else "/equations"
    histories = (history.expression for history in model.histories)
    equations.check_size(reader, (*model.equations, *outputs, *starts, *histories), pointer)


def _check_bounds_rules(reader: DocumentReader, model: Model) -> None:
    """Check that bounds follow the data only where gains and times are those of a plant.

    A state is of the size of the outputs in a recursion too.
    """
    if model.form == "differential":
        return
    starts = zip(model.states, model.initial, strict=True)
    pointers = [
        join_pointer("parameters", p.name) for p in model.parameters if p.bounds is not None
    ]
    pointers += [
        join_pointer("initial", state.name)
        for state, start in starts
        if isinstance(start, EstimatedInitial) and start.bounds not in (None, "state")
    ]
    for pointer in pointers:
        reader.add_fault(pointer + "/bounds", "belongs to the differential form; give numbers")


def _read_form(reader: DocumentReader, document: Mapping[str, Any]) -> ModelForm:
    """Read the form. A wrong one is guessed from the fields, so that their faults are found too."""
    form = reader.require_field(document, "form", "", f"it is one of {', '.join(_FORMS)}")
    if form is not None:
        reader.read_choice(form, _FORMS, "/form")
    if isinstance(form, str) and form in _FORMS:
        return cast(ModelForm, form)
    if "equations" not in document and any(field in document for field in POLYNOMIAL_FIELDS):
        return "polynomial"
    has_samples = _PAST_SAMPLE.search(str(document.get("equations")))
    return "difference" if has_samples else "differential"


def _read_head(reader: DocumentReader, fields: Mapping[str, Any]) -> None:
    name = reader.require_field(fields, "name", "", "a model needs a name, such as my-model")
    if name is not None and not (isinstance(name, str) and _MODEL_NAME.fullmatch(name)):
        need = "need up to 64 of A-Z a-z 0-9 . _ -, starting with a letter or a digit"
        reader.add_fault("/name", f"{quote_value(name)} cannot be a model's name; {need}")
    for field in ("title", "description", "source"):
        reader.read_text(fields.get(field), join_pointer(field))


def _read_equation_model(
    reader: DocumentReader, fields: Mapping[str, Any], form: EquationForm
) -> Model:
    states = read_signals(reader, fields.get("states"), "/states")
    if not fields.get("states"):
        reader.add_fault(
            "/states", "is missing; name at least one state and its unit, such as {x: m}"
        )
    inputs = read_signals(reader, fields.get("inputs"), "/inputs")
    parameters = read_parameters(reader, fields.get("parameters"))
    constants = read_constants(reader, fields.get("constants"))
    scope = _build_scope(form, states, inputs, parameters, fields, constants)
    check_names(
        reader,
        form,
        {
            "states": scope.states,
            "inputs": scope.inputs,
            "parameters": tuple(scope.parameters),
            "constants": tuple(constants),
            "let": _list_names(fields.get("let")),
        },
    )
    intermediates = read_intermediates(reader, fields.get("let"), scope)
    scope = replace(scope, intermediates=intermediates)
    _, trees = equations.read_equations(reader, fields.get("equations"), scope)
    _, outputs = equations.read_outputs(reader, fields.get("outputs"), scope, states)
    _check_output_names(reader, outputs, scope)
    histories = read_histories(reader, fields.get("history"), scope)
    begun = [history.state for history in histories]
    initial = read_initial_states(reader, fields.get("initial"), scope, FixedInitial(0.0), begun)
    initial = derive_starts(reader, dict(zip(scope.states, initial, strict=True)), histories)
    solver = read_solver(reader, fields.get("solver"), form)
    noise = _read_noise(reader, fields.get("noise"), scope, trees, outputs)
    reader.raise_faults()
    initial = _solve_steady_starts(reader, initial, trees, scope)
    _check_measured_starts(reader, initial, trees, outputs, scope)
    return Model(
        name=fields["name"],
        title=reader.read_text(fields.get("title"), "/title", fields["name"]),
        form=form,
        inputs=inputs,
        states=states,
        outputs=outputs,
        parameters=parameters,
        equations=trees,
        initial=initial,
        order=equations.order_states(reader, trees, scope),
        memory=equations.compute_memory(trees) if form == "difference" else 0,
        solver=solver,
        document={},
        histories=histories,
        noise=noise,
    )


def _read_noise(
    reader: DocumentReader,
    value: object,
    scope: Scope,
    trees: tuple[Expression, ...],
    outputs: tuple[Output, ...],
) -> NoisePlaces:
    if value is None:
        return NoisePlaces()
    if len(trees) < len(scope.states):  # the faults of the equations are told first
        return NoisePlaces()
    equations_of = dict(zip(scope.states, trees, strict=True))
    return read_noise(reader, value, equations_of, scope.inputs, outputs)


def _solve_steady_starts(
    reader: DocumentReader,
    starts: tuple[InitialState, ...],
    trees: tuple[Expression, ...],
    scope: Scope,
) -> tuple[InitialState, ...]:
    """Solve for the starts that are steady; the other states are at their own starts."""
    others: dict[str, Expression] = {}
    steady: dict[str, Expression] = {}
    for name, start, tree in zip(scope.states, starts, trees, strict=True):
        if isinstance(start, FixedInitial):
            others[name] = Number(start.value)
        elif isinstance(start, DerivedInitial):
            target = steady if start.text == STEADY else others
            target[name] = tree if start.text == STEADY else start.expression
    if not steady:
        return starts
    try:
        rest = solve_rest(steady, others, scope.parameters, is_rate=scope.form == "differential")
    except NoRestError as error:
        detail = (
            f"{', '.join(steady)} cannot start steady: {error}. Give a number, "
            "{lower, upper}, measured, or an expression such as K*u0"
        )
        pointer = "/initial" if len(steady) > 1 else join_pointer("initial", *steady)
        reader.add_fault(pointer, detail)
        reader.raise_faults()
    return tuple(
        replace(start, expression=rest[name])
        if isinstance(start, DerivedInitial) and name in rest
        else start
        for name, start in zip(scope.states, starts, strict=True)
    )


def _build_scope(
    form: EquationForm,
    states: tuple[ModelSignal, ...],
    inputs: tuple[ModelSignal, ...],
    parameters: tuple[Parameter, ...],
    fields: Mapping[str, Any],
    constants: Mapping[str, float],
) -> Scope:
    declared = fields.get("parameters")
    # A parameter with faults is still declared: its use in an equation is not another fault.
    intervals = dict.fromkeys(declared, (1.0, 1.0)) if isinstance(declared, Mapping) else {}
    intervals = {name: ends for name, ends in intervals.items() if isinstance(name, str)}
    intervals |= {parameter.name: get_interval(parameter) for parameter in parameters}
    named = [tuple(signal.name for signal in group) for group in (states, inputs)]
    return Scope(form, named[0], named[1], intervals, constants)


def _list_names(declared: object) -> tuple[str, ...]:
    if not isinstance(declared, Mapping):
        return ()
    return tuple(n for n, text in declared.items() if isinstance(n, str) and text is not None)


def _check_output_names(reader: DocumentReader, outputs: tuple[Output, ...], scope: Scope) -> None:
    for output in outputs:
        if output.name in scope.inputs:
            reader.add_fault(
                join_pointer("outputs", output.name),
                f"{output.name!r} is also an input; a channel is one or the other",
            )


def find_measured_states(
    states: Sequence[str],
    trees: Sequence[Expression],
    outputs: Sequence[Output],
    *,
    is_rate: bool,
) -> set[str]:
    """Find the states that an output measures, or whose integral it measures."""
    measured = {name for o in outputs if (name := match_plain_state(o.expression))}
    if is_rate:
        rates = (trees[states.index(name)] for name in tuple(measured))
        measured |= {name for tree in rates if (name := match_plain_state(tree))}
    return measured


def _check_measured_starts(
    reader: DocumentReader,
    starts: tuple[InitialState, ...],
    trees: tuple[Expression, ...],
    outputs: tuple[Output, ...],
    scope: Scope,
) -> None:
    """Check that a measured initial state has an output that is that state or its integral."""
    measured = find_measured_states(
        scope.states, trees, outputs, is_rate=scope.form == "differential"
    )
    for name, start in zip(scope.states, starts, strict=True):
        if isinstance(start, MeasuredInitial) and name not in measured:
            detail = (
                f"no output measures {name} or its integral, so its initial value is not "
                "measured; give a number, or {lower, upper} to estimate it"
            )
            reader.add_fault(join_pointer("initial", name), detail)


def _read_polynomial_model(reader: DocumentReader, fields: Mapping[str, Any]) -> Model:
    inputs = read_signals(reader, fields.get("inputs"), "/inputs")
    parameters = read_parameters(reader, fields.get("parameters"))
    constants = read_constants(reader, fields.get("constants"))
    output = _read_single_output(reader, fields.get("output"))
    scope = _build_scope("difference", (output,), inputs, parameters, fields, constants)
    check_names(
        reader,
        "difference",
        {
            "output": scope.states,
            "inputs": scope.inputs,
            "parameters": tuple(scope.parameters),
            "constants": tuple(constants),
            "let": _list_names(fields.get("let")),
        },
    )
    intermediates = read_intermediates(reader, fields.get("let"), scope)
    scope = replace(scope, intermediates=intermediates)
    equation = expand_polynomial(reader, fields, scope)
    read_histories(reader, fields.get("history"), scope)
    initial = read_initial_states(reader, fields.get("initial"), scope, MeasuredInitial())
    initial = derive_starts(reader, {output.name: initial[0]}, ())
    solver = read_solver(reader, fields.get("solver"), "polynomial")
    measured = (Output(output.name, PastValue(output.name, "state"), output.unit),)
    noise = _read_noise(reader, fields.get("noise"), scope, (equation.tree,), measured)
    reader.raise_faults()
    named = {parameter.name: get_interval(parameter) for parameter in equation.coefficients}
    whole = replace(scope, parameters={**named, **scope.parameters})
    initial = _solve_steady_starts(reader, initial, (equation.tree,), whole)
    return Model(
        name=fields["name"],
        title=reader.read_text(fields.get("title"), "/title", fields["name"]),
        form="polynomial",
        inputs=inputs,
        states=(output,),
        outputs=measured,
        parameters=(*equation.coefficients, *parameters),
        equations=(equation.tree,),
        initial=initial,
        order=(0,),
        memory=equations.compute_memory((equation.tree,)),
        solver=solver,
        document={},
        terms=equation.terms,
        rule=equation.rule,
        noise=noise,
    )


def _read_single_output(reader: DocumentReader, value: object) -> ModelSignal:
    """Read the output of a polynomial: ``y``, or ``{y: V}`` with its unit."""
    if isinstance(value, str):
        return ModelSignal(value)
    signals = read_signals(reader, value, "/output")
    if len(signals) != 1:
        reader.add_fault("/output", "need the name of the one output, such as y or {y: V}")
        return ModelSignal("y")
    return signals[0]
