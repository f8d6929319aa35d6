"""How many estimated coefficients stand before past outputs, when a model predicts one step ahead.

Such a prediction reads measured outputs, which hold earlier residuals, so the estimate makes the
residuals' correlations at small lags smaller than those of white noise: Box and Pierce (1970) take
one degree of freedom from the test for each such coefficient. A free run reads no measured output.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sysid.language.delays import collect_past_values
from sysid.language.tree import (
    Binary,
    Expression,
    FunctionCall,
    PastValue,
    Symbol,
    Unary,
    match_plain_state,
)
from sysid.models.model import Model
from sysid.models.parameters import Parameter
from sysid.models.ties import apply_ties, resolve_ties


class _StateFactors(NamedTuple):
    """Of an expression: its parameters, those that multiply a state, and whether it has states."""

    names: frozenset[str] = frozenset()
    multiply: frozenset[str] = frozenset()
    has_state: bool = False


def reads_outputs(model: Model) -> bool:
    """Whether a prediction one step ahead is other than the free run: some output is a state."""
    return any(match_plain_state(output.expression) for output in model.outputs)


def count_past_output_coefficients(model: Model, parameters: Sequence[Parameter]) -> dict[str, int]:
    """Of each output, how many free parameters multiply a state in the equations behind it.

    Parameters
    ----------
    model : Model
    parameters : sequence of Parameter
        All of a problem's. A lag is no coefficient, whether it is free or not.
    """
    model = apply_ties(model, resolve_ties(model, parameters))
    free = {one.name for one in parameters if one.is_free}
    equations = dict(zip((one.name for one in model.states), model.equations, strict=True))
    found = {}
    for output in model.outputs:
        behind = [
            _analyse_expression(equations[state])
            for state in _list_dependencies(output.expression, equations)
        ]
        found[output.name] = len(free & frozenset().union(*(one.multiply for one in behind)))
    return found


def _list_dependencies(tree: Expression, equations: Mapping[str, Expression]) -> list[str]:
    """The states that an expression depends on, and those that these depend on."""
    found = _list_states(tree)
    for state in found:  # grows while it is walked
        found += [one for one in _list_states(equations[state]) if one not in found]
    return found


def _list_states(tree: Expression) -> list[str]:
    return list(dict.fromkeys(one.name for one in collect_past_values(tree) if one.kind == "state"))


def _analyse_expression(tree: Expression) -> _StateFactors:
    match tree:
        case Symbol(name, "parameter"):
            return _StateFactors(names=frozenset({name}))
        case PastValue(_, "state"):
            return _StateFactors(has_state=True)
        case Unary(_, operand):
            return _analyse_expression(operand)
        case Binary(operator, left, right):
            return _combine_factors(
                [_analyse_expression(left), _analyse_expression(right)],
                is_sum=operator in ("+", "-"),
            )
        case FunctionCall(_, arguments):
            return _combine_factors(
                [_analyse_expression(one) for one in arguments], is_sum=False, is_product=False
            )
        case _:
            return _StateFactors()


def _combine_factors(
    parts: Sequence[_StateFactors], *, is_sum: bool, is_product: bool = True
) -> _StateFactors:
    """Of a sum, a product, or else a function, in which every parameter acts on every state."""
    names = frozenset().union(*(one.names for one in parts))
    multiply = frozenset().union(*(one.multiply for one in parts))
    has_state = any(one.has_state for one in parts)
    if has_state and not is_sum:
        for i, one in enumerate(parts):
            others = any(other.has_state for j, other in enumerate(parts) if j != i)
            if others or (one.has_state and not is_product):
                multiply |= one.names
    return _StateFactors(names, multiply, has_state)
