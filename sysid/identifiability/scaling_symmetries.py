"""Scaling symmetries: scalings of the parameters that keep a model's outputs, for any data.

Multiply every parameter and every state by some power of r. If all equations and outputs still
hold, no experiment can tell the parameters apart. Only products of powers that stay the same are
identifiable. For J·dω/dt = A·P - B·ω the symmetry is (J, A, B)·r, which leaves A/J and B/J.

The powers are computed as in dimensional analysis. Every expression has a weight, the power of r by
which it is multiplied. The terms of a sum have equal weights. Inputs, outputs, time, delays and
arguments of functions such as sin have weight 0. So have base and exponent of a power whose
exponent is estimated. Any other exponent is a number such as 2 or 1/3, or a fixed parameter. The
weights satisfy linear equations with rational coefficients, which are solved exactly.
"""

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import lru_cache, reduce
from math import isfinite, nan
from operator import add, mul, sub, truediv

import numpy as np

from sysid.core.types import FloatArray
from sysid.language.tree import Binary, Expression, FunctionCall, Number, PastValue, Symbol, Unary
from sysid.models.model import (
    Correction,
    DerivedInitial,
    EstimatedInitial,
    FixedInitial,
    HistoryFunction,
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
_MAX_DENOMINATOR, _FRACTION_TOLERANCE = 1000, 1e-14

ScalingWeight = Mapping[str, Fraction]
"""Coefficients of a linear form in the powers of parameters and states; empty: weight 0."""


def find_scalings(model: Model, parameters: Sequence[Parameter]) -> FloatArray:
    """Find the exponents of the free parameters under every scaling symmetry.

    Parameters
    ----------
    model : Model
        With its ties resolved.
    parameters : sequence of Parameter
        All parameters of a problem, with initial states.

    Returns
    -------
    FloatArray, shape (k, D)
        A basis in reduced echelon form; k = 0: there is no such symmetry.
    """
    states = tuple(state.name for state in model.states)
    outputs = tuple(output.expression for output in model.outputs)
    return _find_cached_scalings(
        states,
        model.equations,
        outputs,
        model.initial,
        model.histories,
        model.corrections,
        tuple(parameters),
    )


@lru_cache(maxsize=64)
def _find_cached_scalings(
    states: tuple[str, ...],
    equations: tuple[Expression, ...],
    outputs: tuple[Expression, ...],
    initial: tuple[InitialState, ...],
    histories: tuple[HistoryFunction, ...],
    corrections: tuple[Correction, ...],
    parameters: tuple[Parameter, ...],
) -> FloatArray:
    """Find the scalings, cached for the runs of one model; the result is read-only."""
    free = [p.name for p in parameters if p.is_free]
    weights = _WeightEquations(
        {
            p.name: nan if p.fixed is None else p.fixed
            for p in parameters
            if not p.is_free and p.fixed != 0.0
        },
        {p.name for p in parameters if p.fixed == 0.0},
    )
    for state, equation in zip(states, equations, strict=True):
        weights.require_equal({state: Fraction(1)}, weights.weigh_expression(equation))
    for output in outputs:
        weights.require_equal({}, weights.weigh_expression(output))
    _add_initial_conditions(weights, states, initial, {p.name for p in parameters})
    for history in histories:
        weight = weights.weigh_expression(history.expression)
        weights.require_equal({history.state: Fraction(1)}, weight)
    for one in corrections:
        weights.require_equal({}, weights.weigh_expression(one.variance))
        for state, change in (*one.gains, *one.losses):
            weights.require_equal({state: Fraction(1)}, weights.weigh_expression(change))
    null = _solve_null_space(weights.equations, [*states, *free])
    free_rows = [[row.get(name, Fraction(0)) for name in free] for row in null]
    exponents = _reduce_to_echelon(free_rows, len(free))
    exponents.flags.writeable = False
    return exponents


def _add_initial_conditions(
    weights: "_WeightEquations",
    states: Sequence[str],
    initial: Sequence[InitialState],
    names: set[str],
) -> None:
    """Add the initial conditions: a state that starts at a fixed value ≠ 0 has weight 0."""
    for state, start in zip(states, initial, strict=True):
        weight = {state: Fraction(1)}
        match start:
            case FixedInitial(value) if value != 0.0:
                weights.require_equal({}, weight)
            case DerivedInitial(expression):
                weights.require_equal(weight, weights.weigh_expression(expression))
            case MeasuredInitial():
                weights.require_equal({}, weight)
            case EstimatedInitial():
                experiment = 0
                while (name := name_initial_state(state, experiment)) in names:
                    weights.require_equal(
                        weight, weights.weigh_expression(Symbol(name, "parameter"))
                    )
                    experiment += 1


class _WeightEquations:
    """Weights of expressions, and the equations between weights that they imply.

    The weight of an expression that is 0 is None, because every weight fits.
    """

    def __init__(self, fixed: Mapping[str, float], zero: set[str]) -> None:
        self._fixed, self._zero = fixed, zero
        self.equations: list[ScalingWeight] = []

    def require_equal(
        self, a: ScalingWeight | None, b: ScalingWeight | None
    ) -> ScalingWeight | None:
        """Require that two weights are equal; return the one that is not None."""
        if a is None or b is None:
            return b if a is None else a
        difference = _add_weights(a, b, -1)
        if difference:
            self.equations.append(difference)
        return a

    def weigh_expression(self, tree: Expression) -> ScalingWeight | None:
        """Compute the weight of an expression."""
        match tree:
            case Number(value):
                return None if value == 0.0 else {}
            case Symbol(name, "parameter"):
                return self._weigh_parameter(name)
            case PastValue(name, kind, _, delay):
                if delay is not None:
                    self.require_equal({}, self.weigh_expression(delay))
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
        return {} if name in self._fixed else {name: Fraction(1)}

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
        self.require_equal(a, b)  # a comparison stays the same if both sides are scaled alike
        return {}

    def _weigh_power(
        self, base: ScalingWeight | None, exponent: Expression, weight: ScalingWeight | None
    ) -> ScalingWeight | None:
        """Compute the weight of a power; an unknown exponent gives it and the base weight 0."""
        power = _evaluate_fraction(exponent, self._fixed)
        if power is None:
            self.require_equal({}, weight)
            return self._require_zero(base)
        if base is None:
            return None if power > 0 else {}
        return {name: power * share for name, share in base.items() if power}

    def _weigh_call(self, tree: FunctionCall) -> ScalingWeight | None:
        weights = [self.weigh_expression(argument) for argument in tree.arguments]
        match tree.function:
            case "abs":
                return weights[0]
            case "sign":
                return {}
            case "sqrt":
                return None if weights[0] is None else _scale_weight(weights[0], Fraction(1, 2))
            case "min" | "max" | "where" | "mod":
                return self.require_equal(weights[-2], weights[-1])
            case "clip":
                return self.require_equal(weights[0], self.require_equal(*weights[1:]))
            case "table" | "pchip":  # scaled as its y, which follow as many x
                self._require_zero(weights[0])
                return reduce(self.require_equal, weights[1 + len(weights) // 2 :])
            case "atan2":
                self.require_equal(*weights)
                return {}
        return self._require_zero(weights[0])

    def _require_zero(self, argument: ScalingWeight | None) -> ScalingWeight:
        self.require_equal({}, argument)
        return {}


def _evaluate_fraction(tree: Expression, fixed: Mapping[str, float]) -> Fraction | None:
    """Evaluate an expression of numbers and fixed parameters; None if it is no number."""
    match tree:
        case Number(value):
            return _to_fraction(value)
        case Symbol(name, "parameter") if isfinite(fixed.get(name, nan)):
            return _to_fraction(fixed[name])
        case Unary("-", operand):
            inside = _evaluate_fraction(operand, fixed)
            return None if inside is None else -inside
        case Binary(operator, left, right) if operator in _ARITHMETIC:
            a, b = _evaluate_fraction(left, fixed), _evaluate_fraction(right, fixed)
            if a is None or b is None or (operator == "/" and b == 0):
                return None
            return _ARITHMETIC[operator](a, b)
        case _:
            return None


def _to_fraction(value: float) -> Fraction:
    """Convert a number to the intended fraction: 0.1 to 1/10, 0.3333333333333333 to 1/3."""
    near = Fraction(value).limit_denominator(_MAX_DENOMINATOR)
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
    """Solve the equations: a basis of the powers that satisfy all of them."""
    solved: dict[str, ScalingWeight] = {}  # a power in terms of powers that are not in `solved`
    for equation in equations:
        reduced: ScalingWeight = {}
        for name, share in equation.items():
            reduced = _add_weights(
                reduced, _scale_weight(solved.get(name, {name: Fraction(1)}), share), 1
            )
        if not reduced:
            continue
        chosen = next(name for name in names if name in reduced)
        rest = {name: -share / reduced[chosen] for name, share in reduced.items() if name != chosen}
        for name, form in solved.items():
            if chosen in form:
                others = {other: share for other, share in form.items() if other != chosen}
                solved[name] = _add_weights(others, _scale_weight(rest, form[chosen]), 1)
        solved[chosen] = rest
    basis: list[ScalingWeight] = []
    for name in (name for name in names if name not in solved):
        dependent = {other: form[name] for other, form in solved.items() if name in form}
        basis.append({name: Fraction(1), **dependent})
    return basis


def _reduce_to_echelon(rows: list[list[Fraction]], columns: int) -> FloatArray:
    """Reduce rows to echelon form without rows of zeros, as floats."""
    reduced: list[list[Fraction]] = []
    for column in range(columns):
        pivot = next((row for row in rows if row[column]), None)
        if pivot is None:
            continue
        rows = [row for row in rows if row is not pivot]
        pivot = [value / pivot[column] for value in pivot]
        rows = [_eliminate_column(row, pivot, column) for row in rows]
        reduced = [_eliminate_column(row, pivot, column) for row in reduced] + [pivot]
    return np.array(reduced, dtype=np.float64).reshape(len(reduced), columns)


def _eliminate_column(row: list[Fraction], pivot: list[Fraction], column: int) -> list[Fraction]:
    return [a - row[column] * b for a, b in zip(row, pivot, strict=True)]
