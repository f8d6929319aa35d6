"""The state at which equations rest, as expressions of parameters and constant inputs.

At rest no signal changes, so every past value is the present one. Equations that then determine
one state each are solved first, and their solutions are put into the others. A friction at the
velocity 0 vanishes so, although its equation is not linear. What is left must be linear in the
states: it is solved by elimination. Pivots that are zero for any parameters are recognised by
their values at some points inside the bounds.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite

from sysid.language.evaluation import evaluate_expression
from sysid.language.printer import format_expression
from sysid.language.transform import substitute
from sysid.language.tree import (
    Binary,
    Expression,
    FunctionCall,
    Number,
    PastValue,
    Symbol,
    Unary,
    walk,
)

_ZERO, _ONE = Number(0.0), Number(1.0)
_POINTS = 5  # inside the bounds, at which a coefficient must vanish to be zero
_GOLDEN_SHARE = 0.6180339887498949
_ROUNDING = 1e-10  # of the parts of a difference
_MAX_NODES = 100_000
"""Nodes of all expressions that are made on the way; substitution can square their lengths."""


class NoRestError(Exception):
    """There is no rest, or it cannot be computed; the text says why."""


@dataclass(frozen=True, slots=True)
class _Affine:
    """A constant and the factors of the unknown states."""

    constant: Expression
    factors: Mapping[str, Expression] = field(default_factory=dict)


def solve_rest(
    equations: Mapping[str, Expression],
    starts: Mapping[str, Expression],
    intervals: Mapping[str, tuple[float, float]],
    *,
    is_rate: bool,
) -> dict[str, Expression]:
    """Solve for the states at which their equations rest.

    Parameters
    ----------
    equations : mapping of str to Expression
        Of each state to solve for: its rate, or its next value.
    starts : mapping of str to Expression
        Starts of the other states; one that is missing must not occur.
    intervals : mapping of str to (lower, upper)
        Of the parameters.
    is_rate : bool
        Whether the equations give rates.

    Raises
    ------
    NoRestError
        If the equations do not determine these states, or are not linear in them.
    """
    solver = _RestSolver(tuple(equations), intervals)
    return solver.solve(_write_rows(equations, starts, is_rate=is_rate))


def solve_standstill(
    equations: Mapping[str, Expression],
    intervals: Mapping[str, tuple[float, float]],
    *,
    is_rate: bool,
) -> dict[str, Expression]:
    """Solve for the states that a rest determines, whatever the level of an integrator is.

    An integrator may rest at any level, so its state is left out. So is a state whose rest depends
    on such a level. The arguments are those of `solve_rest`.

    Raises
    ------
    NoRestError
        If the equations are not linear in the states, or change with time.
    """
    solver = _RestSolver(tuple(equations), intervals, has_levels=True)
    solved = solver.solve(_write_rows(equations, {}, is_rate=is_rate))
    return {name: tree for name, tree in solved.items() if not _reads_state(tree)}


def _write_rows(
    equations: Mapping[str, Expression], starts: Mapping[str, Expression], *, is_rate: bool
) -> dict[str, Expression]:
    """Write the equations as rows that are zero at rest."""
    held = {name: _hold_signals(tree, starts) for name, tree in equations.items()}
    return {
        name: _drop_divisor(tree) if is_rate else Binary("-", tree, PastValue(name, "state"))
        for name, tree in held.items()
    }


def _reads_state(tree: Expression) -> bool:
    return any(isinstance(node, PastValue) and node.kind == "state" for node in walk(tree))


def _drop_divisor(tree: Expression) -> Expression:
    """Drop a divisor without states: it does not change where a rate is zero."""
    match tree:
        case Binary("/", above, below) if not _reads_state(below):
            return _drop_divisor(above)
        case _:
            return tree


def _hold_signals(tree: Expression, starts: Mapping[str, Expression]) -> Expression:
    """Replace past values by present ones, and states that are not solved for by their starts."""

    def hold(node: Expression) -> Expression | None:
        match node:
            case PastValue(name, "state"):
                return starts.get(name, PastValue(name, "state"))
            case PastValue(name, "input"):
                return PastValue(name, "input")
            case Symbol(name, "time" | "index"):
                raise NoRestError(f"the equations change with {name}")
            case _:
                return None

    return substitute(tree, hold)


class _RestSolver:
    """Solver for unknown states by substitution and elimination.

    With `has_levels`, states that no row determines stay open.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        intervals: Mapping[str, tuple[float, float]],
        *,
        has_levels: bool = False,
    ) -> None:
        self._names, self._has_levels = names, has_levels
        self._nodes = 0
        self._points = [
            {
                name: lower + (upper - lower) * ((i + 1) * _GOLDEN_SHARE + 0.37 * point) % 1.0
                for i, (name, (lower, upper)) in enumerate(intervals.items())
            }
            for point in range(1, _POINTS + 1)
        ]

    def solve(self, rows: dict[str, Expression]) -> dict[str, Expression]:
        """Solve the rows (each zero at rest) for the unknown states."""
        solved: dict[str, Expression] = {}
        while (single := self._find_single(rows)) is not None:
            row, name, value = single
            del rows[row]
            solved[name] = value
            rows = {other: self._substitute(tree, {name: value}) for other, tree in rows.items()}
        rest = self._eliminate({row: self._expand(tree) for row, tree in rows.items()})
        return {name: self._substitute(tree, rest) for name, tree in solved.items()} | rest

    def _substitute(self, tree: Expression, values: Mapping[str, Expression]) -> Expression:
        """Replace states by their values."""

        def find_value(node: Expression) -> Expression | None:
            is_state = isinstance(node, PastValue) and node.kind == "state"
            return values.get(node.name) if is_state else None  # type: ignore[union-attr]

        inserted = (value for node in walk(tree) if (value := find_value(node)) is not None)
        self._count(tree, *inserted)
        return _fold(substitute(tree, find_value))

    def _count(self, *trees: Expression) -> None:
        """Count the nodes of trees that become part of another one.

        Raises
        ------
        NoRestError
            If there are too many by now.
        """
        for tree in trees:
            self._nodes += _count_nodes(tree)
            if self._nodes > _MAX_NODES:
                raise NoRestError("the expressions that solve for it are too long")

    def _find_single(self, rows: Mapping[str, Expression]) -> tuple[str, str, Expression] | None:
        """Find a row that determines one state: the row, the state and its value."""
        for row, tree in rows.items():
            try:
                affine = self._expand(tree)
            except NoRestError:
                continue
            if len(affine.factors) == 1:
                [(name, factor)] = affine.factors.items()
                return row, name, _negate(_divide(affine.constant, factor))
        return None

    def _eliminate(self, rows: dict[str, _Affine]) -> dict[str, Expression]:
        """Solve linear rows by Gauss-Jordan elimination."""
        solved: dict[str, _Affine] = {}
        for row, affine in rows.items():
            reduced = affine
            for name, value in solved.items():
                reduced = self._insert(reduced, name, value)
            if not reduced.factors and self._has_levels:
                continue
            if not reduced.factors:
                raise NoRestError(
                    f"the equation of {row} does not determine it at rest, as of an integrator"
                )
            name = min(reduced.factors, key=lambda other: _count_nodes(reduced.factors[other]))
            pivot = reduced.factors[name]
            value = _Affine(
                _negate(_divide(reduced.constant, pivot)),
                {
                    other: _negate(_divide(factor, pivot))
                    for other, factor in reduced.factors.items()
                    if other != name
                },
            )
            solved = {other: self._insert(old, name, value) for other, old in solved.items()}
            solved[name] = value
        return {name: self._join(value) for name, value in solved.items()}

    def _join(self, value: _Affine) -> Expression:
        """Join a constant and the parts of states that stay open."""
        total = value.constant
        for name, factor in value.factors.items():
            total = self._sum(total, _multiply(factor, PastValue(name, "state")))
        return total

    def _insert(self, affine: _Affine, name: str, value: _Affine) -> _Affine:
        """Insert the value of a state."""
        if name not in affine.factors:
            return affine
        factor = affine.factors[name]
        others = {other: part for other, part in affine.factors.items() if other != name}
        return self._add(_Affine(affine.constant, others), _scale(value, factor))

    def _expand(self, tree: Expression) -> _Affine:
        """Expand an expression that is linear in the unknown states."""
        match tree:
            case PastValue(name, "state"):
                if name in self._names:
                    return _Affine(_ZERO, {name: _ONE})
                raise NoRestError(
                    f"it depends on {name}, whose start is estimated or measured; "
                    f"write {name}: steady too"
                )
            case Unary("-", operand):
                return _scale(self._expand(operand), Number(-1.0))
            case Binary("+" | "-" as operator, left, right):
                second = self._expand(right)
                sign = 1.0 if operator == "+" else -1.0
                return self._add(self._expand(left), _scale(second, Number(sign)))
            case Binary("*" | "/" as operator, left, right):
                scaled = self._scale_factor(operator, self._expand(left), self._expand(right))
                if scaled is not None:
                    return scaled
        if any(isinstance(node, PastValue) and node.name in self._names for node in walk(tree)):
            raise NoRestError(f"{format_expression(tree)} is not linear in the states")
        return _Affine(_fold(tree))

    @staticmethod
    def _scale_factor(operator: str, first: _Affine, second: _Affine) -> _Affine | None:
        """Multiply or divide; None if the result is not linear."""
        if operator == "/":
            if second.factors:
                return None
            return _Affine(
                _divide(first.constant, second.constant),
                {n: _divide(part, second.constant) for n, part in first.factors.items()},
            )
        if first.factors and second.factors:
            return None
        factor, scaled = (second, first) if first.factors else (first, second)
        return _scale(scaled, factor.constant)

    def _add(self, first: _Affine, second: _Affine) -> _Affine:
        names = [*first.factors, *(n for n in second.factors if n not in first.factors)]
        sums = {
            n: self._sum(first.factors.get(n, _ZERO), second.factors.get(n, _ZERO)) for n in names
        }
        return _Affine(
            self._sum(first.constant, second.constant),
            {name: total for name, total in sums.items() if total != _ZERO},
        )

    def _sum(self, first: Expression, second: Expression) -> Expression:
        """Add two expressions; the sum is zero if it vanishes at all points."""
        if _ZERO in (first, second):
            return second if first == _ZERO else first
        self._count(first, second)
        total = _fold(Binary("+", first, second))
        return _ZERO if all(self._cancel(first, second, point) for point in self._points) else total

    def _cancel(self, first: Expression, second: Expression, point: Mapping[str, float]) -> bool:
        a, b = _evaluate(first, point), _evaluate(second, point)
        return isfinite(a) and isfinite(b) and abs(a + b) <= _ROUNDING * (abs(a) + abs(b))


def _evaluate(tree: Expression, point: Mapping[str, float]) -> float:
    """Evaluate with some value for each input and for the sampling period."""

    def number(node: Expression) -> Expression | None:
        match node:
            case PastValue(name, _):
                return Number(1.0 + sum(name.encode()) * _GOLDEN_SHARE % 1.0)
            case Symbol(_, "period"):
                return Number(_GOLDEN_SHARE)
            case _:
                return None

    return evaluate_expression(substitute(tree, number), point)


def _fold(tree: Expression) -> Expression:
    """Compute what has numbers only, and leave out zeros and ones."""
    match tree:
        case Unary("-", operand):
            return _negate(_fold(operand))
        case Binary("*", left, right):
            return _multiply(_fold(left), _fold(right))
        case Binary("/", left, right):
            return _divide(_fold(left), _fold(right))
        case Binary(operator, left, right):
            tree = Binary(operator, _fold(left), _fold(right))
            if operator in ("+", "-") and tree.right == _ZERO:
                return tree.left
        case FunctionCall(function, arguments):
            tree = FunctionCall(function, tuple(_fold(argument) for argument in arguments))
    if isinstance(tree, Binary | FunctionCall) and not any(
        isinstance(node, Symbol | PastValue) for node in walk(tree)
    ):
        value = evaluate_expression(tree, {})
        return Number(value) if isfinite(value) else tree
    return tree


def _scale(affine: _Affine, factor: Expression) -> _Affine:
    return _Affine(
        _multiply(affine.constant, factor),
        {name: _multiply(part, factor) for name, part in affine.factors.items()},
    )


def _negate(tree: Expression) -> Expression:
    match tree:
        case Number(value):
            return Number(-value if value else 0.0)
        case Unary("-", operand):
            return operand
        case _:
            return Unary("-", tree)


def _multiply(first: Expression, second: Expression) -> Expression:
    if _ZERO in (first, second):
        return _ZERO
    if isinstance(first, Number) and isinstance(second, Number):
        return Number(first.value * second.value)
    for one, other in ((first, second), (second, first)):
        if isinstance(one, Number) and abs(one.value) == 1.0:
            return other if one.value > 0 else _negate(other)
    return Binary("*", first, second)


def _divide(first: Expression, second: Expression) -> Expression:
    match first, second:
        case Number(0.0), _:
            return _ZERO
        case _, Number(1.0):
            return first
        case _, Number(-1.0):
            return _negate(first)
        case Unary("-", a), Unary("-", b):
            return _divide(a, b)
        case a, Unary("-", b):
            return _negate(_divide(a, b))
    return _ONE if first == second else Binary("/", first, second)


def _count_nodes(tree: Expression) -> int:
    return sum(1 for _ in walk(tree))
