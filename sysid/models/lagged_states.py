"""A recursion whose fixed lags are states, so that a filter corrects the past as well.

An equation that reads x(k-1), x(k-2) … depends on several samples of one state. The state
``x[1]`` is x(k-1), and so on. Then every sample depends on the one before it alone, and a filter of
these states is exact where the recursion is linear (Anderson and Moore, Optimal Filtering, 1979,
ch. 7.3). Further reads, and those with an unknown delay, remain reads of the past.

The first samples of a recursion, as many as its `memory`, are its start.
"""

from dataclasses import replace

from sysid.language.delays import collect_past_values
from sysid.language.transform import substitute
from sysid.language.tree import (
    Binary,
    Expression,
    FunctionCall,
    Number,
    PastValue,
    Symbol,
)
from sysid.models.model import DerivedInitial, FixedInitial, InitialState, Model, ModelSignal

MOST_LAGS = 8
"""Largest fixed lag (samples) that becomes a state; a covariance grows with its square."""


def add_lagged_states(model: Model) -> Model:
    """Add the fixed lags of a recursion as states."""
    names, starts = list(model.states), list(model.initial)
    equations = [_replace_lags(one, 1) for one in model.equations]
    for state, start in zip(model.states, model.initial, strict=True):
        for lag in range(1, _find_furthest(model, state.name) + 1):
            names.append(ModelSignal(name_lag(state.name, lag), state.unit))
            equations.append(PastValue(name_lag(state.name, lag - 1), "state", 1))
            starts.append(_derive_start(state.name, start, model))
    return replace(
        model,
        states=tuple(names),
        equations=tuple(equations),
        outputs=tuple(
            replace(one, expression=_replace_lags(one.expression, 0)) for one in model.outputs
        ),
        initial=tuple(starts),
        order=(*model.order, *range(len(model.states), len(names))),
    )


def name_lag(state: str, lag: int) -> str:
    """Name the state that another one was some samples ago; 0 is itself."""
    return f"{state}[{lag}]" if lag else state


def hold_first_samples(model: Model, held: Expression, computed: Expression) -> Expression:
    """Choose one expression in the first samples of a recursion, and another one after them."""
    if model.memory <= 1 or held == computed:
        return computed
    is_first = Binary("<", Symbol("k", "index"), Number(float(model.memory)))
    return FunctionCall("where", (is_first, held, computed))


def _derive_start(state: str, start: InitialState, model: Model) -> InitialState:
    """Derive the start of a lag: that of its state, or zero if the document says so."""
    if model.solver.history == "zero":
        return FixedInitial(0.0)
    text = start.text if isinstance(start, DerivedInitial) else state
    return DerivedInitial(PastValue(state, "state"), text)


def _find_furthest(model: Model, state: str) -> int:
    """Find how many lags of a state are states: one less than equations read, as outputs do."""
    own = [0]
    for trees, present in (
        (model.equations, 1),
        ([one.expression for one in model.outputs], 0),
    ):
        own += [
            past.offset - present
            for tree in trees
            for past in collect_past_values(tree)
            if past.name == state and _is_followed(past)
        ]
    return max(own)


def _is_followed(past: PastValue) -> bool:
    return past.kind == "state" and past.delay is None and past.offset <= MOST_LAGS


def _replace_lags(tree: Expression, present: int) -> Expression:
    """Read lags from their states, `present` samples back."""

    def find_lag(node: Expression) -> Expression | None:
        if isinstance(node, PastValue) and _is_followed(node) and node.offset > present:
            return PastValue(name_lag(node.name, node.offset - present), "state", present)
        return None

    return substitute(tree, find_lag)
