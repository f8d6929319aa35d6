"""Equivalent subsystems of a model: the parameters to exchange so that one becomes the other.

Two parallel first-order subsystems can be exchanged only with their gains and initial states. The
equations show which parameters belong together: replacing names in pairs turns the equation of one
state into that of the other. Whether the output stays the same is not tested here, but by
simulation in `sysid.identifiability.exchange`. So candidates may be wrong, and sums are not sorted.
"""

from collections.abc import Iterator, Mapping
from itertools import combinations

from sysid.language.tree import Binary, Expression, FunctionCall, PastValue, Symbol, Unary
from sysid.models.model import (
    DerivedInitial,
    EstimatedInitial,
    FixedInitial,
    InitialState,
    Model,
    name_initial_state,
)
from sysid.models.parameters import Parameter
from sysid.simulation.problem import Problem

ExchangeUnit = tuple[int, ...]
"""Indices of free parameters that move together."""

_COMMUTATIVE = ("binary", "+"), ("binary", "*")

_Renaming = Mapping[str, str]  # each name and its replacement, both ways

_MAX_NODES = 4000
"""Limit on the nodes examined for two states.

Subsystems need some hundreds. If nothing fits, each sum of names doubles the number of orders."""


def find_equivalent_subsystems(problem: Problem) -> Iterator[tuple[ExchangeUnit, ExchangeUnit]]:
    """Iterate over pairs of equivalent units with several parameters, in matching order."""
    if problem.model.form == "polynomial":
        return  # each state is a past value
    model = problem.model
    for first, second in combinations([state.name for state in model.states], 2):
        names = _match_states(model, first, second)
        units = None if names is None else _locate_exchange(problem, names)
        if units is not None and len(units[0]) > 1:
            yield units


def _match_states(model: Model, first: str, second: str) -> _Renaming | None:
    """Match the equations of two states, and of the states they read, by a renaming."""
    equations = dict(zip((state.name for state in model.states), model.equations, strict=True))
    names: _Renaming = {first: second, second: first}
    waiting, seen = [(first, second)], {first, second}
    nodes_left = iter(range(_MAX_NODES))
    while waiting:
        state, counterpart = waiting.pop()
        renaming = next(
            _match_expressions(equations[state], equations[counterpart], names, nodes_left), None
        )
        if renaming is None:
            return None
        names = renaming
        new = [(a, b) for a, b in names.items() if a in equations and a != b and a not in seen]
        for a, b in new:
            if a not in seen:
                waiting.append((a, b))
                seen |= {a, b}
    return names


def _match_expressions(
    tree: Expression, other_tree: Expression, names: _Renaming, nodes_left: Iterator[int]
) -> Iterator[_Renaming]:
    """Iterate over extensions of a renaming that turn one tree into the other.

    `nodes_left` yields once for each node that may still be examined.
    """
    if next(nodes_left, None) is None:
        return
    (kind, name, parts), (other_kind, other_name, other_parts) = (
        _split_expression(tree),
        _split_expression(other_tree),
    )
    if kind != other_kind:
        return
    orders = [other_parts, other_parts[::-1]] if kind in _COMMUTATIVE else [other_parts]
    for renaming in _extend_renaming(name, other_name, names):
        for order in orders:
            yield from _match_operands(parts, order, renaming, nodes_left)


def _split_expression(tree: Expression) -> tuple[tuple[object, ...], str, tuple[Expression, ...]]:
    """Split an expression into its fixed part, its replaceable name (or none) and operands."""
    match tree:
        case Symbol(name, "parameter"):
            return ("parameter",), name, ()
        case PastValue(name, "state", offset, delay):
            return ("state", offset, delay is None), name, _list_delay_operands(delay)
        case PastValue(name, _, offset, delay):
            return ("input", name, offset, delay is None), "", _list_delay_operands(delay)
        case Unary(operator, operand):
            return ("unary", operator), "", (operand,)
        case Binary(operator, left, right):
            return ("binary", operator), "", (left, right)
        case FunctionCall(function, arguments):
            return ("call", function, len(arguments)), "", arguments
        case _:
            return ("given", tree), "", ()


def _list_delay_operands(delay: Expression | None) -> tuple[Expression, ...]:
    return () if delay is None else (delay,)


def _match_operands(
    operands: tuple[Expression, ...],
    other_operands: tuple[Expression, ...],
    names: _Renaming,
    nodes_left: Iterator[int],
) -> Iterator[_Renaming]:
    if not operands:
        yield names
        return
    for renaming in _match_expressions(operands[0], other_operands[0], names, nodes_left):
        yield from _match_operands(operands[1:], other_operands[1:], renaming, nodes_left)


def _extend_renaming(name: str, replacement: str, names: _Renaming) -> list[_Renaming]:
    if not name:
        return [names]
    if name in names or replacement in names:
        return [names] * (names.get(name) == replacement)
    return [{**names, name: replacement, replacement: name}]


def _locate_exchange(
    problem: Problem, names: _Renaming
) -> tuple[ExchangeUnit, ExchangeUnit] | None:
    """Locate the exchanged free parameters; None if fixed values or initial states differ."""
    states = [item.name for item in problem.model.states]
    initial = dict(zip(states, problem.model.initial, strict=True))
    pairs_by_name: list[tuple[str, str]] = []
    for a, b in _iterate_pairs(names):
        if a not in initial:
            pairs_by_name.append((a, b))
        elif not _have_same_start(initial[a], initial[b]):
            return None
        elif isinstance(initial[a], EstimatedInitial):
            every = range(len(problem.records))
            pairs_by_name += [(name_initial_state(a, e), name_initial_state(b, e)) for e in every]
    parameters = {item.name: item for item in problem.all_parameters}
    if not all(_are_interchangeable(parameters[a], parameters[b]) for a, b in pairs_by_name):
        return None
    free = {item.name: d for d, item in enumerate(problem.free_parameters)}
    pairs = sorted((free[a], free[b]) for a, b in pairs_by_name if a in free)
    return tuple(a for a, _ in pairs), tuple(b for _, b in pairs)


def _have_same_start(first: InitialState, second: InitialState) -> bool:
    if isinstance(first, EstimatedInitial):
        return isinstance(second, EstimatedInitial)
    if isinstance(first, DerivedInitial):  # the exchange is simulated before it counts
        return isinstance(second, DerivedInitial)
    return isinstance(first, FixedInitial) and first == second


def _are_interchangeable(first: Parameter, second: Parameter) -> bool:
    if first.unit != second.unit or first.is_free != second.is_free:
        return False
    return first.is_free or (first.fixed is not None and first.fixed == second.fixed)


def _iterate_pairs(names: _Renaming) -> Iterator[tuple[str, str]]:
    """Iterate over the pairs of different names, each once, in order."""
    seen: set[str] = set()
    for a, b in names.items():
        if a != b and a not in seen:
            seen |= {a, b}
            yield a, b
