"""Scalings of the parameters that leave a model's outputs as they are, whatever the data.

If every parameter is multiplied by r to some power, and every state too, and each equation and
each output holds as before, then no experiment can tell the parameters apart: only products of
powers that stay the same are identifiable. For J·dω/dt = A·P - B·ω that is (J, A, B)·r, which
leaves A/J and B/J.

The powers are found as in dimensional analysis. Every expression gets a weight, the power of r by
which it is multiplied; the terms of a sum must have equal weights, what a function such as sin is
taken of has weight 0, and so have inputs, outputs, time, lags, and both sides of a power whose
exponent is to be estimated. These are linear equations with rational coefficients, and they are
solved exactly; the exponent of a power is a number such as 2, 1/3 or a fixed parameter.
"""

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import lru_cache
from math import isfinite, nan
from operator import add, mul, sub, truediv

import numpy as np

from sysid.core.types import FloatArray
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary
from sysid.models.model import (
    EstimatedInitial,
    FixedInitial,
    InitialState,
    MeasuredInitial,
    Model,
    name_initial_state,
)
from sysid.models.parameters import Parameter

_ARITHMETIC: Mapping[str, Callable[[Fraction, Fraction], Fraction]] = {
    "+": add,
    "-": sub,
    "*": mul,
    "/": truediv,
}
_LARGEST_DENOMINATOR, _FRACTION_TOLERANCE = 1000, 1e-14

ScalingWeight = Mapping[str, Fraction]
"""Coefficients of a linear form in the powers of parameters and states; empty: weight 0."""


def find_scalings(model: Model, parameters: Sequence[Parameter]) -> FloatArray:
    """Exponents of the free parameters under every scaling symmetry.

    Parameters
    ----------
    model : Model
        Its ties resolved.
    parameters : sequence of Parameter
        All of a problem's, initial states too.

    Returns
    -------
    FloatArray, shape (k, D)
        A basis in reduced echelon form; k = 0 where there is no such symmetry.
    """
    states = tuple(state.name for state in model.states)
    outputs = tuple(output.expression for output in model.outputs)
    return _find_cached_scalings(states, model.equations, outputs, model.initial, tuple(parameters))


@lru_cache(maxsize=64)
def _find_cached_scalings(
    states: tuple[str, ...],
    equations: tuple[Expression, ...],
    outputs: tuple[Expression, ...],
    initial: tuple[InitialState, ...],
    parameters: tuple[Parameter, ...],
) -> FloatArray:
    """The same, kept for the many runs of one model; not to be written to."""
    free = [p.name for p in parameters if p.is_free]
    walk = _WeightEquations(
        {
            p.name: nan if p.fixed is None else p.fixed
            for p in parameters
            if not p.is_free and p.fixed != 0.0
        },
        {p.name for p in parameters if p.fixed == 0.0},
    )
    for state, equation in zip(states, equations, strict=True):
        walk.require_equal({state: Fraction(1)}, walk.weigh_expression(equation))
    for output in outputs:
        walk.require_equal({}, walk.weigh_expression(output))
    _add_initial_conditions(walk, states, initial, {p.name for p in parameters})
    null = _solve_null_space(walk.equations, [*states, *free])
    kept = [[row.get(name, Fraction(0)) for name in free] for row in null]
    found = _reduce_to_echelon(kept, len(free))
    found.flags.writeable = False
    return found


def _add_initial_conditions(
    walk: "_WeightEquations",
    states: Sequence[str],
    initial: Sequence[InitialState],
    known: set[str],
) -> None:
    """A state that starts at a known value other than 0 cannot be scaled."""
    for state, start in zip(states, initial, strict=True):
        own = {state: Fraction(1)}
        match start:
            case FixedInitial(value) if value != 0.0:
                walk.require_equal({}, own)
            case MeasuredInitial():
                walk.require_equal({}, own)
            case EstimatedInitial():
                experiment = 0
                while (name := name_initial_state(state, experiment)) in known:
                    walk.require_equal(own, walk.weigh_expression(Symbol(name, "parameter")))
                    experiment += 1


class _WeightEquations:
    """Weights of expressions, and the equations between weights that were met on the way.

    The weight of what is 0 is None: it has every weight.
    """

    def __init__(self, known: Mapping[str, float], zero: set[str]) -> None:
        self._known, self._zero = known, zero
        self.equations: list[ScalingWeight] = []

    def require_equal(
        self, a: ScalingWeight | None, b: ScalingWeight | None
    ) -> ScalingWeight | None:
        """Note that two weights are equal; gives the one that says something."""
        if a is None or b is None:
            return b if a is None else a
        difference = _add_weights(a, b, -1)
        if difference:
            self.equations.append(difference)
        return a

    def weigh_expression(self, tree: Expression) -> ScalingWeight | None:
        """Weight of an expression."""
        match tree:
            case Number(value):
                return None if value == 0.0 else {}
            case Symbol(name, "parameter"):
                return self._weigh_parameter(name)
            case PastValue(name, kind, _, lag):
                if lag is not None:
                    self.require_equal({}, self.weigh_expression(lag))
                return {} if kind == "input" else {name: Fraction(1)}
            case Unary(_, operand):
                return self.weigh_expression(operand)
            case Binary():
                return self._weigh_binary(tree)
            case FunctionCall():
                return self._weigh_call(tree)
            case _:  # time, the sample number, the sampling period
                return {}

    def _weigh_parameter(self, name: str) -> ScalingWeight | None:
        if name in self._zero:
            return None
        return {} if name in self._known else {name: Fraction(1)}

    def _weigh_binary(self, tree: Binary) -> ScalingWeight | None:
        a, b = self.weigh_expression(tree.left), self.weigh_expression(tree.right)
        match tree.operator:
            case "+" | "-":
                return self.require_equal(a, b)
            case "*":
                return None if a is None or b is None else _add_weights(a, b, 1)
            case "/":
                return None if a is None else _add_weights(a, b or {}, -1)
            case "**":
                return self._weigh_power(a, tree.right, b)
            case "and" | "or":
                return {}
        self.require_equal(a, b)  # a comparison holds as before if both sides are scaled alike
        return {}

    def _weigh_power(
        self, base: ScalingWeight | None, exponent: Expression, weight: ScalingWeight | None
    ) -> ScalingWeight | None:
        """Of a power; one whose exponent is not known pins the base and the exponent."""
        power = _evaluate_fraction(exponent, self._known)
        if power is None:
            self.require_equal({}, weight)
            return self._require_zero(base)
        if base is None:
            return None if power > 0 else {}
        return {name: power * share for name, share in base.items() if power}

    def _weigh_call(self, tree: FunctionCall) -> ScalingWeight | None:
        weights = [self.weigh_expression(one) for one in tree.arguments]
        match tree.function:
            case "abs":
                return weights[0]
            case "sign":
                return {}
            case "sqrt":
                return None if weights[0] is None else _scale_weight(weights[0], Fraction(1, 2))
            case "min" | "max" | "where":
                return self.require_equal(weights[-2], weights[-1])
        return self._require_zero(weights[0])

    def _require_zero(self, argument: ScalingWeight | None) -> ScalingWeight:
        self.require_equal({}, argument)
        return {}


def _evaluate_fraction(tree: Expression, known: Mapping[str, float]) -> Fraction | None:
    """What an expression of numbers and fixed parameters is worth; None if it is no number."""
    match tree:
        case Number(value):
            return _to_fraction(value)
        case Symbol(name, "parameter") if isfinite(known.get(name, nan)):
            return _to_fraction(known[name])
        case Unary("-", operand):
            inside = _evaluate_fraction(operand, known)
            return None if inside is None else -inside
        case Binary(operator, left, right) if operator in _ARITHMETIC:
            a, b = _evaluate_fraction(left, known), _evaluate_fraction(right, known)
            if a is None or b is None or (operator == "/" and b == 0):
                return None
            return _ARITHMETIC[operator](a, b)
        case _:
            return None


def _to_fraction(value: float) -> Fraction:
    """A number as it was meant: 0.1 and 0.3333333333333333 as 1/10 and 1/3, others as they are."""
    near = Fraction(value).limit_denominator(_LARGEST_DENOMINATOR)
    return near if abs(float(near) - value) <= _FRACTION_TOLERANCE * abs(value) else Fraction(value)


def _add_weights(a: ScalingWeight, b: ScalingWeight, sign: int) -> ScalingWeight:
    total = dict(a)
    for name, share in b.items():
        total[name] = total.get(name, Fraction(0)) + sign * share
    return {name: share for name, share in total.items() if share}


def _scale_weight(a: ScalingWeight, factor: Fraction) -> ScalingWeight:
    return {name: factor * share for name, share in a.items()}


def _solve_null_space(
    equations: Sequence[ScalingWeight], names: Sequence[str]
) -> list[ScalingWeight]:
    """A basis of the powers that satisfy every equation."""
    solved: dict[str, ScalingWeight] = {}  # a power in terms of powers that are not in `solved`
    for equation in equations:
        left: ScalingWeight = {}
        for name, share in equation.items():
            left = _add_weights(
                left, _scale_weight(solved.get(name, {name: Fraction(1)}), share), 1
            )
        if not left:
            continue
        chosen = next(name for name in names if name in left)
        rest = {name: -share / left[chosen] for name, share in left.items() if name != chosen}
        for name, form in solved.items():
            if chosen in form:
                kept = {other: share for other, share in form.items() if other != chosen}
                solved[name] = _add_weights(kept, _scale_weight(rest, form[chosen]), 1)
        solved[chosen] = rest
    basis: list[ScalingWeight] = []
    for name in (name for name in names if name not in solved):
        own = {other: form[name] for other, form in solved.items() if name in form}
        basis.append({name: Fraction(1), **own})
    return basis


def _reduce_to_echelon(rows: list[list[Fraction]], columns: int) -> FloatArray:
    """Reduced echelon form without rows of zeros, as numbers."""
    done: list[list[Fraction]] = []
    for column in range(columns):
        pivot = next((row for row in rows if row[column]), None)
        if pivot is None:
            continue
        rows = [row for row in rows if row is not pivot]
        pivot = [value / pivot[column] for value in pivot]
        rows = [_eliminate_column(row, pivot, column) for row in rows]
        done = [_eliminate_column(row, pivot, column) for row in done] + [pivot]
    return np.array(done, dtype=np.float64).reshape(len(done), columns)


def _eliminate_column(row: list[Fraction], pivot: list[Fraction], column: int) -> list[Fraction]:
    return [a - row[column] * b for a, b in zip(row, pivot, strict=True)]
