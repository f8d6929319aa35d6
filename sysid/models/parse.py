"""Model documents: from YAML or JSON data to a checked `Model`, every fault at once."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

from sysid.core.errors import Fault, InvalidModel, InvalidSettings, join_pointer
from sysid.language.scope import Scope, Timing
from sysid.language.tree import Expression, Past, match_plain_state
from sysid.models import equations as eq
from sysid.models.documents import Reader, shown
from sysid.models.model import FixedInitial, Form, Initial, MeasuredInitial, Model, Output, Quantity
from sysid.models.normal_form import normal_form
from sysid.models.parameters import Parameter
from sysid.models.polynomial import FIELDS as POLYNOMIAL_FIELDS
from sysid.models.polynomial import expand
from sysid.models.sections import (
    check_names,
    constants,
    initial,
    interval,
    parameters,
    signals,
    solver,
)
from sysid.models.ties import ties_of
from sysid.models.units import check_lag_units

_COMMON = (
    "name", "title", "description", "source", "form", "inputs", "parameters", "constants",
    "initial", "solver",
)  # fmt: skip
_FORMS = ("difference", "differential", "polynomial")
_FIELDS = {
    "difference": (*_COMMON, "states", "equations", "outputs"),
    "differential": (*_COMMON, "states", "equations", "outputs"),
    "polynomial": (*_COMMON, *POLYNOMIAL_FIELDS),
}
_MODEL_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


def parse_model(document: object) -> Model:
    """The model that a document describes.

    Parameters
    ----------
    document : object
        A mapping as read from YAML or JSON.

    Raises
    ------
    InvalidModel
        With every fault, each with its JSON pointer and, inside an equation, its column.
    """
    reader = Reader()
    if not isinstance(document, Mapping):
        raise InvalidModel([Fault("", f"a model is a mapping of fields, not {shown(document)}")])
    form = _form(reader, document)
    fields = reader.section(document, "", _FIELDS[form])
    _head(reader, fields)
    model = _polynomial(reader, fields) if form == "polynomial" else _equations(reader, fields)
    check_lag_units(reader, model)
    reader.finish()
    model = replace(model, document=normal_form(fields, model))
    try:
        ties_of(model, model.parameters)
    except InvalidSettings as error:
        raise InvalidModel([Fault(error.pointer, error.detail)]) from None
    return model


def with_terms(model: Model, labels: Sequence[str]) -> Model:
    """The polynomial with only these of its terms (``"1"``: the constant), in this order."""
    listed = [label for label in labels if label != "1"]
    document = {**model.document, "terms": listed, "constant": "1" in labels}
    return parse_model(document)


def _form(reader: Reader, document: Mapping[str, Any]) -> Form:
    found = reader.required(document, "form", "", f"it is one of {', '.join(_FORMS)}")
    if found is not None:
        found = reader.choice(found, _FORMS, "/form")
    reader.finish()  # without the form it is not known which fields belong here
    return cast(Form, found)


def _head(reader: Reader, fields: Mapping[str, Any]) -> None:
    name = reader.required(fields, "name", "", "a model needs a name, such as my-model")
    if name is not None and not (isinstance(name, str) and _MODEL_NAME.fullmatch(name)):
        need = "need up to 64 of A-Z a-z 0-9 . _ -, starting with a letter or a digit"
        reader.fault("/name", f"{shown(name)} cannot be a model's name; {need}")
    for field in ("title", "description", "source"):
        reader.text(fields.get(field), join_pointer(field))


def _equations(reader: Reader, fields: Mapping[str, Any]) -> Model:
    form: Timing = fields["form"]
    states = signals(reader, fields.get("states"), "/states")
    if not fields.get("states"):
        reader.fault("/states", "is missing; name at least one state and its unit, such as {x: m}")
    inputs = signals(reader, fields.get("inputs"), "/inputs")
    found = parameters(reader, fields.get("parameters"))
    known = constants(reader, fields.get("constants"))
    scope = _scope(form, states, inputs, found, fields, known)
    check_names(
        reader,
        form,
        {
            "states": scope.states,
            "inputs": scope.inputs,
            "parameters": tuple(scope.parameters),
            "constants": tuple(known),
        },
    )
    _, trees = eq.equations(reader, fields.get("equations"), scope)
    _, outputs = eq.outputs(reader, fields.get("outputs"), scope, states)
    _check_outputs(reader, outputs, scope)
    starts = initial(reader, fields.get("initial"), scope.states, FixedInitial(0.0))
    settings = solver(reader, fields.get("solver"), form)
    reader.finish()
    _check_measured(reader, starts, trees, outputs, scope)
    return Model(
        name=fields["name"],
        title=reader.text(fields.get("title"), "/title", fields["name"]),
        form=form,
        inputs=inputs,
        states=states,
        outputs=outputs,
        parameters=found,
        equations=trees,
        initial=starts,
        order=eq.order(reader, trees, scope),
        memory=eq.memory(trees) if form == "difference" else 0,
        solver=settings,
        document={},
    )


def _scope(
    form: Timing,
    states: tuple[Quantity, ...],
    inputs: tuple[Quantity, ...],
    found: tuple[Parameter, ...],
    fields: Mapping[str, Any],
    known: Mapping[str, float],
) -> Scope:
    declared = fields.get("parameters")
    # A parameter with faults is still declared: its name in an equation is not one fault more.
    intervals = dict.fromkeys(declared, (1.0, 1.0)) if isinstance(declared, Mapping) else {}
    intervals = {name: ends for name, ends in intervals.items() if isinstance(name, str)}
    intervals |= {parameter.name: interval(parameter) for parameter in found}
    named = [tuple(one.name for one in group) for group in (states, inputs)]
    return Scope(form, named[0], named[1], intervals, known)


def _check_outputs(reader: Reader, outputs: tuple[Output, ...], scope: Scope) -> None:
    for output in outputs:
        if output.name in scope.inputs:
            reader.fault(
                join_pointer("outputs", output.name),
                f"{output.name!r} is an input, too; a channel is one or the other",
            )


def _check_measured(
    reader: Reader,
    starts: tuple[Initial, ...],
    trees: tuple[Expression, ...],
    outputs: tuple[Output, ...],
    scope: Scope,
) -> None:
    """A measured start needs an output that is that state, or whose rate the state is."""
    seen = {name for o in outputs if (name := match_plain_state(o.expression))}
    if scope.form == "differential":
        rates = (trees[scope.states.index(name)] for name in tuple(seen))
        seen |= {name for tree in rates if (name := match_plain_state(tree))}
    for name, start in zip(scope.states, starts, strict=True):
        if isinstance(start, MeasuredInitial) and name not in seen:
            detail = (
                f"no output is just {name}, nor has {name} as its rate, so its start is not "
                "measured; give a number, or {lower, upper} to estimate it"
            )
            reader.fault(join_pointer("initial", name), detail)


def _polynomial(reader: Reader, fields: Mapping[str, Any]) -> Model:
    inputs = signals(reader, fields.get("inputs"), "/inputs")
    found = parameters(reader, fields.get("parameters"))
    known = constants(reader, fields.get("constants"))
    output = _single_output(reader, fields.get("output"))
    scope = _scope("difference", (output,), inputs, found, fields, known)
    check_names(
        reader,
        "difference",
        {
            "output": scope.states,
            "inputs": scope.inputs,
            "parameters": tuple(scope.parameters),
            "constants": tuple(known),
        },
    )
    found_terms = expand(reader, fields, scope)
    starts = initial(reader, fields.get("initial"), scope.states, MeasuredInitial())
    settings = solver(reader, fields.get("solver"), "polynomial")
    reader.finish()
    return Model(
        name=fields["name"],
        title=reader.text(fields.get("title"), "/title", fields["name"]),
        form="polynomial",
        inputs=inputs,
        states=(output,),
        outputs=(Output(output.name, Past(output.name, "state"), output.unit),),
        parameters=(*found_terms.coefficients, *found),
        equations=(found_terms.tree,),
        initial=starts,
        order=(0,),
        memory=eq.memory((found_terms.tree,)),
        solver=settings,
        document={},
        terms=found_terms.terms,
        rule=found_terms.rule,
    )


def _single_output(reader: Reader, value: object) -> Quantity:
    """The output of a polynomial: ``y``, or ``{y: V}`` with its unit."""
    if isinstance(value, str):
        return Quantity(value)
    found = signals(reader, value, "/output")
    if len(found) != 1:
        reader.fault("/output", "need the name of the one output, such as y or {y: V}")
        return Quantity("y")
    return found[0]
