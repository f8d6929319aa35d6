"""Parameters tied to others: ``b = 2*a``, put into the model's equations before they are compiled.

A tie is an expression of other parameters and the model's constants, in the language of the
equations. Those others may be free, fixed, or tied themselves, as long as no circle arises. In the
end every tie says what a parameter is in terms of parameters that are not tied.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from sysid.core.errors import InvalidSettings
from sysid.language.checker import check_expression
from sysid.language.delays import mentions_time
from sysid.language.scope import Scope
from sysid.language.transform import substitute
from sysid.language.tree import Expression, Symbol, walk
from sysid.models.model import Model
from sysid.models.parameters import Parameter

Ties = Mapping[str, Expression]
"""What each tied parameter is, in terms of free and fixed ones."""


def resolve_ties(model: Model, parameters: Sequence[Parameter]) -> Ties:
    """The ties of a problem's parameters, resolved.

    Parameters
    ----------
    model : Model
        For its constants.
    parameters : sequence of Parameter
        All of the problem's.

    Raises
    ------
    InvalidSettings
        With the pointer of a tie that does not parse, names what is not there, changes with time
        or leads back to its own parameter.
    """
    written = {
        p.name: _parse_tie(model, parameters, p.name, p.tied)
        for p in parameters
        if p.tied is not None
    }
    resolved: dict[str, Expression] = {}
    for name in written:
        _resolve_tie(name, written, resolved, ())
    return resolved


def apply_ties(model: Model, ties: Ties) -> Model:
    """The model with every tied parameter replaced, in the lags of past values too."""
    if not ties:
        return model
    return replace(
        model,
        equations=tuple(_substitute_ties(tree, ties) for tree in model.equations),
        outputs=tuple(
            replace(output, expression=_substitute_ties(output.expression, ties))
            for output in model.outputs
        ),
    )


def _substitute_ties(tree: Expression, ties: Ties) -> Expression:
    def tied(node: Expression) -> Expression | None:
        match node:
            case Symbol(name, "parameter"):
                return ties.get(name)
            case _:
                return None

    return substitute(tree, tied)


def _parse_tie(model: Model, parameters: Sequence[Parameter], name: str, text: str) -> Expression:
    pointer = f"/parameters/{name}/tied"
    own = {p.name for p in model.parameters}
    if name not in own:
        raise InvalidSettings(
            pointer, f"{name!r} is an initial state, which cannot be tied; fix it or leave it free"
        )
    others = {p.name: (p.lower, p.upper) for p in parameters if p.name in own}
    constants = {key: float(v) for key, v in model.document.get("constants", {}).items()}
    found = check_expression(text, Scope("differential", parameters=others, constants=constants))
    if found.tree is None:
        column, detail = found.faults[0]
        raise InvalidSettings(pointer, f"column {column} of {text!r}: {detail}")
    if mentions_time(found.tree):
        raise InvalidSettings(pointer, f"{text!r} changes with time; tie it to parameters only")
    return found.tree


def _resolve_tie(
    name: str, written: Ties, resolved: dict[str, Expression], path: tuple[str, ...]
) -> None:
    """Put the ties that a tie names into it, theirs first."""
    if name in path:
        circle = " → ".join((*path[path.index(name) :], name))
        raise InvalidSettings(
            f"/parameters/{name}/tied",
            f"the ties go in a circle, {circle}; leave one of these parameters free or fix it",
        )
    if name in resolved:
        return
    for other in sorted(collect_parameter_names(written[name]) & set(written)):
        _resolve_tie(other, written, resolved, (*path, name))
    resolved[name] = _substitute_ties(written[name], resolved)


def collect_parameter_names(tree: Expression) -> set[str]:
    """Names of the parameters in an expression, and in the lags of its past values."""
    return {
        node.name for node in walk(tree) if isinstance(node, Symbol) and node.kind == "parameter"
    }
