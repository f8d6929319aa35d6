"""Number of estimated coefficients of past outputs in predictions one step ahead.

Such a prediction reads measured outputs, which contain earlier residuals. So the estimate makes the
residual correlations at small lags smaller than those of white noise. Box and Pierce (1970)
subtract one degree of freedom from the test for each such coefficient. A free run reads no measured
output.
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
from sysid.models.kalman_filter import is_noise_parameter
from sysid.models.model import Model
from sysid.models.parameters import Parameter
from sysid.models.ties import apply_ties, resolve_ties


class _StateFactors(NamedTuple):
    """Parameters of an expression, those that multiply a state, and whether it has states."""

    names: frozenset[str] = frozenset()
    multiply: frozenset[str] = frozenset()
    has_state: bool = False


def reads_outputs(model: Model) -> bool:
    """Return whether some output is a state, so that one-step predictions differ from free runs."""
    return any(match_plain_state(output.expression) for output in model.outputs)


def count_past_output_coefficients(model: Model, parameters: Sequence[Parameter]) -> dict[str, int]:
    """Count for each output the free parameters that multiply a state in its equations.

    Parameters
    ----------
    model : Model
    parameters : sequence of Parameter
        All parameters of a problem. A delay is no coefficient, free or not. Those of a filter are
        counted instead if the model has one.
    """
    model = apply_ties(model, resolve_ties(model, parameters))
    free = {item.name for item in parameters if item.is_free}
    if model.corrections:
        noise = sum(map(is_noise_parameter, free))
        return {output.name: noise for output in model.outputs}
    equations = dict(zip((item.name for item in model.states), model.equations, strict=True))
    counts = {}
    for output in model.outputs:
        equation_factors = [
            _analyse_expression(equations[state])
            for state in _list_dependencies(output.expression, equations)
        ]
        counts[output.name] = len(
            free & frozenset().union(*(item.multiply for item in equation_factors))
        )
    return counts


def _list_dependencies(tree: Expression, equations: Mapping[str, Expression]) -> list[str]:
    """List the states that an expression depends on, directly or through other states."""
    states = _list_states(tree)
    for state in states:  # grows during the iteration
        states += [name for name in _list_states(equations[state]) if name not in states]
    return states


def _list_states(tree: Expression) -> list[str]:
    return list(
        dict.fromkeys(past.name for past in collect_past_values(tree) if past.kind == "state")
    )


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
                [_analyse_expression(argument) for argument in arguments],
                is_sum=False,
                is_product=False,
            )
        case _:
            return _StateFactors()


def _combine_factors(
    parts: Sequence[_StateFactors], *, is_sum: bool, is_product: bool = True
) -> _StateFactors:
    """Combine the factors of a sum, a product, or a function of parameters and states."""
    names = frozenset().union(*(part.names for part in parts))
    multiply = frozenset().union(*(part.multiply for part in parts))
    has_state = any(part.has_state for part in parts)
    if has_state and not is_sum:
        for i, part in enumerate(parts):
            others = any(other.has_state for j, other in enumerate(parts) if j != i)
            if others or (part.has_state and not is_product):
                multiply |= part.names
    return _StateFactors(names, multiply, has_state)
