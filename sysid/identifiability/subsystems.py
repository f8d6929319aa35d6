"""Sections of a model that are alike: what has to change places for one to become the other.

Two first orders side by side can be exchanged only together with their gains and their initial
states. Which parameter goes with which, the equations say: that of one state becomes that of the
other, where names are replaced in pairs. Whether the output is the same then is not asked here
(`sysid.identifiability.exchange` simulates it), so candidates may be wrong, and sums are not
sorted.
"""

from collections.abc import Iterator, Mapping
from itertools import combinations

from sysid.language.tree import Binary, Expression, FunctionCall, PastValue, Symbol, Unary
from sysid.models.model import (
    EstimatedInitial,
    FixedInitial,
    InitialState,
    Model,
    name_initial_state,
)
from sysid.models.parameters import Parameter
from sysid.simulation.problem import Problem

ExchangeUnit = tuple[int, ...]
"""Places in the problem's space that move together."""

_COMMUTATIVE = ("binary", "+"), ("binary", "*")

_Renaming = Mapping[str, str]  # each name and what it is replaced by, both ways

_MOST_NODES = 4000
"""Nodes that are looked at for two states. Sections are told by some hundreds; where nothing fits,
the ways to read sums of names either way double with each of them."""


def find_equivalent_subsystems(problem: Problem) -> Iterator[tuple[ExchangeUnit, ExchangeUnit]]:
    """Pairs of units, the place in one beside that in the other; units of several places only."""
    if problem.model.form == "polynomial":
        return  # each state is a past value
    model = problem.model
    for first, second in combinations([one.name for one in model.states], 2):
        names = _match_states(model, first, second)
        found = None if names is None else _locate_exchange(problem, names)
        if found is not None and len(found[0]) > 1:
            yield found


def _match_states(model: Model, first: str, second: str) -> _Renaming | None:
    """What one state's equation, and those of the states that it reads, replace for the other."""
    equations = dict(zip((one.name for one in model.states), model.equations, strict=True))
    names: _Renaming = {first: second, second: first}
    waiting, seen = [(first, second)], {first, second}
    left = iter(range(_MOST_NODES))
    while waiting:
        one, other = waiting.pop()
        found = next(_match_expressions(equations[one], equations[other], names, left), None)
        if found is None:
            return None
        names = found
        new = [(a, b) for a, b in names.items() if a in equations and a != b and a not in seen]
        for a, b in new:
            if a not in seen:
                waiting.append((a, b))
                seen |= {a, b}
    return names


def _match_expressions(
    one: Expression, other: Expression, names: _Renaming, left: Iterator[int]
) -> Iterator[_Renaming]:
    """The ways to replace more names so that one tree becomes the other.

    `left` gives a number for each node that may still be looked at.
    """
    if next(left, None) is None:
        return
    (kind, name, parts), (also, by, others) = _split_expression(one), _split_expression(other)
    if kind != also:
        return
    orders = [others, others[::-1]] if kind in _COMMUTATIVE else [others]
    for known in _extend_renaming(name, by, names):
        for order in orders:
            yield from _match_operands(parts, order, known, left)


def _split_expression(tree: Expression) -> tuple[tuple[object, ...], str, tuple[Expression, ...]]:
    """What cannot be replaced, the name that can (or none), and what it is made of."""
    match tree:
        case Symbol(name, "parameter"):
            return ("parameter",), name, ()
        case PastValue(name, "state", offset, lag):
            return ("state", offset, lag is None), name, _list_delay_operands(lag)
        case PastValue(name, _, offset, lag):
            return ("input", name, offset, lag is None), "", _list_delay_operands(lag)
        case Unary(operator, operand):
            return ("unary", operator), "", (operand,)
        case Binary(operator, left, right):
            return ("binary", operator), "", (left, right)
        case FunctionCall(function, arguments):
            return ("call", function, len(arguments)), "", arguments
        case _:
            return ("given", tree), "", ()


def _list_delay_operands(lag: Expression | None) -> tuple[Expression, ...]:
    return () if lag is None else (lag,)


def _match_operands(
    ones: tuple[Expression, ...],
    others: tuple[Expression, ...],
    names: _Renaming,
    left: Iterator[int],
) -> Iterator[_Renaming]:
    if not ones:
        yield names
        return
    for found in _match_expressions(ones[0], others[0], names, left):
        yield from _match_operands(ones[1:], others[1:], found, left)


def _extend_renaming(one: str, other: str, names: _Renaming) -> list[_Renaming]:
    if not one:
        return [names]
    if one in names or other in names:
        return [names] * (names.get(one) == other)
    return [{**names, one: other, other: one}]


def _locate_exchange(
    problem: Problem, names: _Renaming
) -> tuple[ExchangeUnit, ExchangeUnit] | None:
    """The places that are exchanged; None where one is given, or begins, unlike the other."""
    states = [one.name for one in problem.model.states]
    initial = dict(zip(states, problem.model.initial, strict=True))
    told: list[tuple[str, str]] = []
    for a, b in _iterate_pairs(names):
        if a not in initial:
            told.append((a, b))
        elif not _have_same_start(initial[a], initial[b]):
            return None
        elif isinstance(initial[a], EstimatedInitial):
            every = range(len(problem.records))
            told += [(name_initial_state(a, e), name_initial_state(b, e)) for e in every]
    known = {one.name: one for one in problem.all_parameters}
    if not all(_are_interchangeable(known[a], known[b]) for a, b in told):
        return None
    free = {one.name: d for d, one in enumerate(problem.free_parameters)}
    pairs = sorted((free[a], free[b]) for a, b in told if a in free)
    return tuple(a for a, _ in pairs), tuple(b for _, b in pairs)


def _have_same_start(one: InitialState, other: InitialState) -> bool:
    if isinstance(one, EstimatedInitial):
        return isinstance(other, EstimatedInitial)
    return isinstance(one, FixedInitial) and one == other


def _are_interchangeable(one: Parameter, other: Parameter) -> bool:
    if one.unit != other.unit or one.is_free != other.is_free:
        return False
    return one.is_free or (one.fixed is not None and one.fixed == other.fixed)


def _iterate_pairs(names: _Renaming) -> Iterator[tuple[str, str]]:
    """Each pair of names that differ, once, in the order in which they were found."""
    told: set[str] = set()
    for a, b in names.items():
        if a != b and a not in told:
            told |= {a, b}
            yield a, b
