"""A recursion whose lags are states, so that a filter corrects the past as well.

An equation that reads x(k-1), x(k-2) … depends on several samples of one state. The state
``x[1]`` is x(k-1), and so on. Then every sample depends on the one before it alone, and a filter of
these states is exact where the recursion is linear (Anderson and Moore, Optimal Filtering, 1979,
ch. 7.3). A read with an unknown delay lies on a straight line between two of them. Longer lags, and
those on other curves, remain reads of the past.

The first samples of a recursion, as many as its `memory`, are its start.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import ceil

from sysid.language.delays import collect_past_values
from sysid.language.derivative import ONE, ZERO, add, multiply, subtract
from sysid.language.transform import substitute
from sysid.language.tree import (
    Binary,
    Expression,
    FunctionCall,
    Number,
    PastValue,
    Symbol,
)
from sysid.language.value_intervals import bound_expression
from sysid.models.model import DerivedInitial, FixedInitial, InitialState, Model, ModelSignal

MOST_LAGS = 8
"""Largest lag (samples) that becomes a state.

A covariance grows with its square. A population's filter of 300 samples took 0.5 µs for each
individual without such lags, 0.9 with 5, 1.8 with 8, but 9.3 with 12 (registers of 512 bits).
"""


def add_lagged_states(
    model: Model, intervals: Mapping[str, tuple[float, float]], step: float
) -> Model:
    """Add the lags of a recursion as states.

    Parameters
    ----------
    model : Model
    intervals : mapping of str to (lower, upper)
        Of the parameters, which limit delays.
    step : float
        Step of the recursion, s; a smaller one leaves more reads of the past.
    """
    lags = _Lags(model, intervals, step)
    names, starts = list(model.states), list(model.initial)
    equations = [lags.replace_reads(one, 1) for one in model.equations]
    for state, start in zip(model.states, model.initial, strict=True):
        for lag in range(1, lags.find_furthest(state.name) + 1):
            names.append(ModelSignal(name_lag(state.name, lag), state.unit))
            equations.append(PastValue(name_lag(state.name, lag - 1), "state", 1))
            starts.append(_derive_start(state.name, start, model))
    return replace(
        model,
        states=tuple(names),
        equations=tuple(equations),
        outputs=tuple(
            replace(one, expression=lags.replace_reads(one.expression, 0)) for one in model.outputs
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


@dataclass(frozen=True, slots=True)
class _Lags:
    """The reads of the past that are read from states."""

    model: Model
    intervals: Mapping[str, tuple[float, float]]
    step: float

    def find_furthest(self, state: str) -> int:
        """Find how many lags of a state are states: equations read the last sample as it is."""
        trees = [(tree, 1) for tree in self.model.equations]
        trees += [(output.expression, 0) for output in self.model.outputs]
        furthest = [
            (last or 0) - present
            for tree, present in trees
            for past in collect_past_values(tree)
            if past.name == state and (last := self._find_last(past)) is not None
        ]
        return max([0, *furthest])

    def replace_reads(self, tree: Expression, present: int) -> Expression:
        """Read lags from their states, as they are or `present` samples back."""

        def find_lag(node: Expression) -> Expression | None:
            if not isinstance(node, PastValue) or (last := self._find_last(node)) is None:
                return None
            total: Expression = ZERO
            for lag, share in _divide_read(node, last):
                total = add(total, multiply(share, _read_lag(node.name, lag, present)))
            return total

        return substitute(tree, find_lag)

    def _find_last(self, past: PastValue) -> int | None:
        """Find the furthest sample of a read; None if it remains a read of the past."""
        if past.kind != "state":
            return None
        last = past.offset
        if past.delay is not None:
            _, most = bound_expression(past.delay, self.intervals, self.step)
            if self.model.solver.interpolation != "linear" or not most <= MOST_LAGS:
                return None
            last += ceil(most)
        return last if last <= MOST_LAGS else None


def _divide_read(past: PastValue, last: int) -> Iterator[tuple[int, Expression]]:
    """Divide a read between samples: the lag of each, and its share."""
    if past.delay is None:
        yield past.offset, ONE
        return
    for lag in range(past.offset, last + 1):
        distance = subtract(past.delay, Number(float(lag - past.offset)))
        share = Binary("-", ONE, FunctionCall("abs", (distance,)))
        yield lag, FunctionCall("max", (share, ZERO))


def _read_lag(state: str, lag: int, present: int) -> PastValue:
    if lag < present:
        return PastValue(state, "state")
    return PastValue(name_lag(state, lag - present), "state", present)
