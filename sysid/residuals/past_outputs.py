"""How many estimated coefficients stand before past outputs, when a model predicts one step ahead.

Such a prediction reads measured outputs, which hold earlier residuals, so the estimate makes the
residuals' correlations at small lags smaller than those of white noise: Box and Pierce (1970) take
one degree of freedom from the test for each such coefficient. A free run reads no measured output.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from sysid.language.delays import past_values
from sysid.language.tree import Binary, Call, Expression, Past, Symbol, Unary, match_plain_state
from sysid.models.model import Model
from sysid.models.parameters import Parameter
from sysid.models.ties import tied_model, ties_of


class _Seen(NamedTuple):
    """Of an expression: its parameters, those that multiply a state, and whether it has states."""

    names: frozenset[str] = frozenset()
    multiply: frozenset[str] = frozenset()
    has_state: bool = False


def reads_outputs(model: Model) -> bool:
    """Whether a prediction one step ahead is other than the free run: some output is a state."""
    return any(match_plain_state(output.expression) for output in model.outputs)


def coefficients_on_past_outputs(model: Model, parameters: Sequence[Parameter]) -> dict[str, int]:
    """Of each output, how many free parameters multiply a state in the equations behind it.

    Parameters
    ----------
    model : Model
    parameters : sequence of Parameter
        All of a problem's. A lag is no coefficient, whether it is free or not.
    """
    model = tied_model(model, ties_of(model, parameters))
    free = {one.name for one in parameters if one.is_free}
    equations = dict(zip((one.name for one in model.states), model.equations, strict=True))
    found = {}
    for output in model.outputs:
        behind = [_seen(equations[state]) for state in _behind(output.expression, equations)]
        found[output.name] = len(free & frozenset().union(*(one.multiply for one in behind)))
    return found


def _behind(tree: Expression, equations: Mapping[str, Expression]) -> list[str]:
    """The states that an expression depends on, and those that these depend on."""
    found = _states(tree)
    for state in found:  # grows while it is walked
        found += [one for one in _states(equations[state]) if one not in found]
    return found


def _states(tree: Expression) -> list[str]:
    return list(dict.fromkeys(one.name for one in past_values(tree) if one.kind == "state"))


def _seen(tree: Expression) -> _Seen:
    match tree:
        case Symbol(name, "parameter"):
            return _Seen(names=frozenset({name}))
        case Past(_, "state"):
            return _Seen(has_state=True)
        case Unary(_, operand):
            return _seen(operand)
        case Binary(operator, left, right):
            return _together([_seen(left), _seen(right)], is_sum=operator in ("+", "-"))
        case Call(_, arguments):
            return _together([_seen(one) for one in arguments], is_sum=False, is_product=False)
        case _:
            return _Seen()


def _together(parts: Sequence[_Seen], *, is_sum: bool, is_product: bool = True) -> _Seen:
    """Of a sum, a product, or else a function, in which every parameter acts on every state."""
    names = frozenset().union(*(one.names for one in parts))
    multiply = frozenset().union(*(one.multiply for one in parts))
    has_state = any(one.has_state for one in parts)
    if has_state and not is_sum:
        for i, one in enumerate(parts):
            others = any(other.has_state for j, other in enumerate(parts) if j != i)
            if others or (one.has_state and not is_product):
                multiply |= one.names
    return _Seen(names, multiply, has_state)
