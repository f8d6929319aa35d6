"""Ties between parameters, such as ``b = 2*a``; substituted into the equations before compiling.

A tie is an expression of other parameters, constants and intermediate names, in the language of
the equations. Such a name may not read signals. The other parameters may be free, fixed or tied
themselves, as long as the ties are not circular. A resolved tie contains only parameters that are
not tied.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from sysid.core.errors import InvalidSettings
from sysid.language.checker import check_expression
from sysid.language.delays import mentions_time
from sysid.language.scope import EquationForm, Scope
from sysid.language.transform import substitute
from sysid.language.tree import Expression, Symbol, walk
from sysid.models.document_reader import DocumentReader
from sysid.models.intermediates import read_intermediates
from sysid.models.model import DerivedInitial, Model
from sysid.models.parameters import Parameter
from sysid.models.sections import get_interval

Ties = Mapping[str, Expression]
"""Expression of each tied parameter, in free and fixed ones."""


def resolve_ties(model: Model, parameters: Sequence[Parameter]) -> Ties:
    """Resolve the ties of a problem's parameters.

    Parameters
    ----------
    model : Model
        Its constants and intermediate names may occur in ties.
    parameters : sequence of Parameter
        All parameters of the problem.

    Raises
    ------
    InvalidSettings
        With the pointer of a tie that cannot be parsed, has unknown names, changes with time or is
        circular.
    """
    texts = {p.name: p.tied for p in parameters if p.tied is not None}
    if not texts:
        return {}
    scope = _build_scope(model, parameters)
    written = {name: _parse_tie(scope, name, text) for name, text in texts.items()}
    resolved: dict[str, Expression] = {}
    for name in written:
        _resolve_tie(name, written, resolved, ())
    return resolved


def apply_ties(model: Model, ties: Ties) -> Model:
    """Replace every tied parameter in a model, also in the delays of past values."""
    if not ties:
        return model
    return replace(
        model,
        equations=tuple(_substitute_ties(tree, ties) for tree in model.equations),
        outputs=tuple(
            replace(output, expression=_substitute_ties(output.expression, ties))
            for output in model.outputs
        ),
        initial=tuple(
            replace(start, expression=_substitute_ties(start.expression, ties))
            if isinstance(start, DerivedInitial)
            else start
            for start in model.initial
        ),
        histories=tuple(
            replace(history, expression=_substitute_ties(history.expression, ties))
            for history in model.histories
        ),
        corrections=tuple(
            one.map(lambda tree: _substitute_ties(tree, ties)) for one in model.corrections
        ),
    )


def _substitute_ties(tree: Expression, ties: Ties) -> Expression:
    def find_tie(node: Expression) -> Expression | None:
        match node:
            case Symbol(name, "parameter"):
                return ties.get(name)
            case _:
                return None

    return substitute(tree, find_tie)


def _build_scope(model: Model, parameters: Sequence[Parameter]) -> Scope:
    """Build the scope of ties; its only signals are those that intermediate names read."""
    own_names = {p.name for p in model.parameters}
    ends = {p.name: (p.lower, p.upper) for p in parameters if p.name in own_names}
    constants = {key: float(v) for key, v in model.document.get("constants", {}).items()}
    scope = Scope("differential", parameters=ends, constants=constants)
    if not (let := model.document.get("let")):
        return scope
    states, inputs = (tuple(one.name for one in group) for group in (model.states, model.inputs))
    form: EquationForm = "differential" if model.form == "differential" else "difference"
    declared = {p.name: get_interval(p) for p in model.parameters}  # lags are checked in these
    whole = replace(scope, form=form, states=states, inputs=inputs, parameters=declared)
    reader = DocumentReader()
    intermediates = read_intermediates(reader, let, whole)
    reader.raise_faults()
    return replace(scope, intermediates=intermediates)


def _parse_tie(scope: Scope, name: str, text: str) -> Expression:
    pointer = f"/parameters/{name}/tied"
    if name not in scope.parameters:
        raise InvalidSettings(
            pointer, f"{name!r} is an initial state, which cannot be tied; fix it or leave it free"
        )
    checked = check_expression(text, scope)
    if checked.tree is None:
        column, detail = checked.faults[0]
        raise InvalidSettings(pointer, f"column {column} of {text!r}: {detail}")
    for value, column in checked.uses:
        detail = f"this reads {value.name!r}; tie it to parameters only"
        raise InvalidSettings(pointer, f"column {column} of {text!r}: {detail}")
    if mentions_time(checked.tree, "time", "index", "period"):
        detail = "changes with time or the sampling; tie it to parameters only"
        raise InvalidSettings(pointer, f"{text!r} {detail}")
    return checked.tree


def _resolve_tie(
    name: str, written: Ties, resolved: dict[str, Expression], path: tuple[str, ...]
) -> None:
    """Substitute the ties that a tie refers to, after theirs are resolved."""
    if name in path:
        circle = " → ".join((*path[path.index(name) :], name))
        raise InvalidSettings(
            f"/parameters/{name}/tied",
            f"the ties are circular, {circle}; leave one of these parameters free or fix it",
        )
    if name in resolved:
        return
    for other in sorted(collect_parameter_names(written[name]) & set(written)):
        _resolve_tie(other, written, resolved, (*path, name))
    resolved[name] = _substitute_ties(written[name], resolved)


def collect_parameter_names(tree: Expression) -> set[str]:
    """Collect the parameters of an expression, including the delays of its past values."""
    return {
        node.name for node in walk(tree) if isinstance(node, Symbol) and node.kind == "parameter"
    }
