"""Sections of a model that are alike: what has to change places for one to become the other.

Two first orders side by side can be exchanged only together with their gains and their initial
states. Which parameter goes with which, the equations say: that of one state becomes that of the
other, where names are replaced in pairs. Whether the output is the same then is not asked here
(`sysid.identifiability.exchange` simulates it), so candidates may be wrong, and sums are not
sorted.
"""

from collections.abc import Iterator, Mapping
from itertools import combinations

from sysid.language.tree import Binary, Call, Expression, Past, Symbol, Unary
from sysid.models.model import EstimatedInitial, FixedInitial, Initial, Model, initial_name
from sysid.models.parameters import Parameter
from sysid.simulation.problem import Problem

Unit = tuple[int, ...]
"""Places in the problem's space that move together."""

_EITHER_WAY = ("binary", "+"), ("binary", "*")

_Names = Mapping[str, str]  # each name and what it is replaced by, both ways

_MOST = 4000
"""Nodes that are looked at for two states. Sections are told by some hundreds; where nothing fits,
the ways to read sums of names either way double with each of them."""


def alike(problem: Problem) -> Iterator[tuple[Unit, Unit]]:
    """Pairs of units, the place in one beside that in the other; units of several places only."""
    if problem.model.form == "polynomial":
        return  # each state is a past value
    model = problem.model
    for first, second in combinations([one.name for one in model.states], 2):
        names = _section(model, first, second)
        found = None if names is None else _places(problem, names)
        if found is not None and len(found[0]) > 1:
            yield found


def _section(model: Model, first: str, second: str) -> _Names | None:
    """What one state's equation, and those of the states that it reads, replace for the other."""
    equations = dict(zip((one.name for one in model.states), model.equations, strict=True))
    names: _Names = {first: second, second: first}
    waiting, seen = [(first, second)], {first, second}
    left = iter(range(_MOST))
    while waiting:
        one, other = waiting.pop()
        found = next(_replaced(equations[one], equations[other], names, left), None)
        if found is None:
            return None
        names = found
        new = [(a, b) for a, b in names.items() if a in equations and a != b and a not in seen]
        for a, b in new:
            if a not in seen:
                waiting.append((a, b))
                seen |= {a, b}
    return names


def _replaced(
    one: Expression, other: Expression, names: _Names, left: Iterator[int]
) -> Iterator[_Names]:
    """The ways to replace more names so that one tree becomes the other.

    `left` gives a number for each node that may still be looked at.
    """
    if next(left, None) is None:
        return
    (kind, name, parts), (also, by, others) = _apart(one), _apart(other)
    if kind != also:
        return
    orders = [others, others[::-1]] if kind in _EITHER_WAY else [others]
    for known in _bound(name, by, names):
        for order in orders:
            yield from _all_replaced(parts, order, known, left)


def _apart(tree: Expression) -> tuple[tuple[object, ...], str, tuple[Expression, ...]]:
    """What cannot be replaced, the name that can (or none), and what it is made of."""
    match tree:
        case Symbol(name, "parameter"):
            return ("parameter",), name, ()
        case Past(name, "state", offset, lag):
            return ("state", offset, lag is None), name, _parts(lag)
        case Past(name, _, offset, lag):
            return ("input", name, offset, lag is None), "", _parts(lag)
        case Unary(operator, operand):
            return ("unary", operator), "", (operand,)
        case Binary(operator, left, right):
            return ("binary", operator), "", (left, right)
        case Call(function, arguments):
            return ("call", function, len(arguments)), "", arguments
        case _:
            return ("given", tree), "", ()


def _parts(lag: Expression | None) -> tuple[Expression, ...]:
    return () if lag is None else (lag,)


def _all_replaced(
    ones: tuple[Expression, ...], others: tuple[Expression, ...], names: _Names,
    left: Iterator[int],
) -> Iterator[_Names]:  # fmt: skip
    if not ones:
        yield names
        return
    for found in _replaced(ones[0], others[0], names, left):
        yield from _all_replaced(ones[1:], others[1:], found, left)


def _bound(one: str, other: str, names: _Names) -> list[_Names]:
    if not one:
        return [names]
    if one in names or other in names:
        return [names] * (names.get(one) == other)
    return [{**names, one: other, other: one}]


def _places(problem: Problem, names: _Names) -> tuple[Unit, Unit] | None:
    """The places that are exchanged; None where one is given, or begins, unlike the other."""
    states = [one.name for one in problem.model.states]
    initial = dict(zip(states, problem.model.initial, strict=True))
    told: list[tuple[str, str]] = []
    for a, b in _once(names):
        if a not in initial:
            told.append((a, b))
        elif not _begin_alike(initial[a], initial[b]):
            return None
        elif isinstance(initial[a], EstimatedInitial):
            every = range(len(problem.records))
            told += [(initial_name(a, e), initial_name(b, e)) for e in every]
    known = {one.name: one for one in problem.all_parameters}
    if not all(_are_alike(known[a], known[b]) for a, b in told):
        return None
    free = {one.name: d for d, one in enumerate(problem.space)}
    pairs = sorted((free[a], free[b]) for a, b in told if a in free)
    return tuple(a for a, _ in pairs), tuple(b for _, b in pairs)


def _begin_alike(one: Initial, other: Initial) -> bool:
    if isinstance(one, EstimatedInitial):
        return isinstance(other, EstimatedInitial)
    return isinstance(one, FixedInitial) and one == other


def _are_alike(one: Parameter, other: Parameter) -> bool:
    if one.unit != other.unit or one.is_free != other.is_free:
        return False
    return one.is_free or (one.fixed is not None and one.fixed == other.fixed)


def _once(names: _Names) -> Iterator[tuple[str, str]]:
    """Each pair of names that differ, once, in the order in which they were found."""
    told: set[str] = set()
    for a, b in names.items():
        if a != b and a not in told:
            told |= {a, b}
            yield a, b
