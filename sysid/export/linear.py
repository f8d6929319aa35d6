"""Whether a model is linear with constant coefficients, found from its trees, and its matrices."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import floor
from typing import NamedTuple

import numpy as np

from sysid.errors import SysidError
from sysid.export.identified import Identified
from sysid.kernels.demand import is_difference
from sysid.language.evaluation import value as number_of
from sysid.language.printer import text
from sysid.language.substitution import substitute
from sysid.language.tree import Binary, Call, Expression, Number, Past, Symbol, Unary


class NotLinear(SysidError, ValueError):
    """A model has no transfer function; the message says which term is in the way."""


class Signal(NamedTuple):
    """A state or an input, `delay` s (differential form) or samples (difference) ago."""

    name: str
    kind: str
    delay: float


@dataclass(frozen=True, slots=True)
class Affine:
    """Σ coefficient · signal + constant."""

    terms: Mapping[Signal, float]
    constant: float = 0.0

    def plus(self, other: "Affine", factor: float = 1.0) -> "Affine":
        """Sum with a multiple of another."""
        terms = dict(self.terms)
        for signal, coefficient in other.terms.items():
            terms[signal] = terms.get(signal, 0.0) + factor * coefficient
        found = {signal: value for signal, value in terms.items() if value != 0.0}
        return Affine(found, self.constant + factor * other.constant)

    def times(self, factor: float) -> "Affine":
        """Product with a number."""
        return Affine({}).plus(self, factor)


@dataclass(frozen=True, slots=True)
class Linear:
    """Equations and outputs of a model as affine forms, in the model's order."""

    equations: tuple[Affine, ...]
    outputs: tuple[Affine, ...]


def linear_form(identified: Identified, period: float | None) -> Linear:
    """The model as a linear one.

    Parameters
    ----------
    identified : Identified
    period : float or None
        Integration step of a difference equation in s, which its coefficients may hold.

    Raises
    ------
    NotLinear
        If a term is not linear in states and inputs, or its coefficient changes with time.
    """
    model = identified.model
    clock = "k" if is_difference(model) else "t"
    numbers = identified.numbers

    def known(node: Expression) -> Expression | None:
        match node:
            case Symbol(name, "parameter"):
                return Number(numbers[name])
            case Symbol(_, "period") if period is not None:
                return Number(period)
        return None

    def read(tree: Expression, where: str) -> Affine:
        return _Reader(where, clock).affine(substitute(tree, known))

    return Linear(
        tuple(
            read(tree, f"the equation of {state.name}")
            for state, tree in zip(model.states, model.equations, strict=True)
        ),
        tuple(read(one.expression, f"the output {one.name}") for one in model.outputs),
    )


@dataclass(frozen=True, slots=True)
class _Reader:
    where: str
    clock: str

    def affine(self, tree: Expression) -> Affine:
        """The tree, in which parameters are numbers already, as an affine form."""
        match tree:
            case Number(value):
                return Affine({}, value)
            case Past(name, kind, offset, lag):
                delay = offset + (0.0 if lag is None else max(number_of(lag, {}), 0.0))
                return Affine({Signal(name, kind, float(delay)): 1.0})
            case Symbol(name):
                raise NotLinear(f"{self.where} changes with {name}, so it has no transfer function")
            case Unary("-", operand):
                return self.affine(operand).times(-1.0)
            case Binary("+" | "-" as sign, left, right):
                return self.affine(left).plus(self.affine(right), 1.0 if sign == "+" else -1.0)
            case Binary("*", left, right):
                return self._product(tree, self.affine(left), self.affine(right))
            case Binary("/", left, right):
                return self._quotient(tree, self.affine(left), self.affine(right))
            case _:
                return self._other(tree)

    def _product(self, tree: Expression, left: Affine, right: Affine) -> Affine:
        if left.terms and right.terms:
            raise self._refusal(tree)
        return left.times(right.constant) if left.terms else right.times(left.constant)

    def _quotient(self, tree: Expression, left: Affine, right: Affine) -> Affine:
        if right.terms:
            raise self._refusal(tree)
        if right.constant == 0.0:
            raise NotLinear(f"{self.where} divides by zero in {text(tree, self.clock)}")
        return left.times(1.0 / right.constant)

    def _other(self, tree: Expression) -> Affine:
        """Functions, powers and conditions: of numbers only, or a choice that numbers decide."""
        match tree:
            case Binary("**", base, Number(1.0)):
                return self.affine(base)
            case Call("where", (condition, first, second)) if not self._has_signals(condition):
                return self.affine(first if number_of(condition, {}) else second)
        if self._has_signals(tree):
            raise self._refusal(tree)
        return Affine({}, number_of(tree, {}))

    def _has_signals(self, tree: Expression) -> bool:
        match tree:
            case Past():
                return True
            case Symbol(name):
                raise NotLinear(f"{self.where} changes with {name}, so it has no transfer function")
            case Unary(_, operand):
                return self._has_signals(operand)
            case Binary(_, left, right):
                return self._has_signals(left) or self._has_signals(right)
            case Call(_, arguments):
                return any(self._has_signals(one) for one in arguments)
        return False

    def _refusal(self, tree: Expression) -> NotLinear:
        return NotLinear(
            f"{self.where} is not linear in states and inputs: {text(tree, self.clock)}; "
            "only a linear model has a transfer function"
        )


def taps(identified: Identified, signal: Signal, ramp: float) -> dict[int, float]:
    """Weights of whole samples that give a signal between them, as the simulation reads it."""
    solver, delay = identified.model.solver, signal.delay
    if delay == floor(delay):
        return {int(delay): 1.0}
    if solver.interpolation == "nearest":
        return {floor(delay + 0.5): 1.0}
    if signal.kind == "input" and identified.hold(signal.name) == "zero":
        return _held_taps(delay, ramp)
    place = -delay
    i = floor(place)
    part = place - i
    nodes: tuple[int, ...] = (0, 1)
    if signal.kind == "state" and solver.interpolation == "cubic":
        nodes = (-1, 0, 1, 2) if i <= -3 else (-1, 0, 1)
    return {
        -(i + a): float(np.prod([(part - b) / (a - b) for b in nodes if b != a])) for a in nodes
    }


def _held_taps(delay: float, ramp: float) -> dict[int, float]:
    place = -delay + ramp
    nearest = floor(place + 0.5)
    part = min(max((place - nearest + ramp) / (2 * ramp), 0.0), 1.0)
    found = {-(nearest - 1): 1.0 - part, -nearest: part}
    return {back: weight for back, weight in found.items() if weight != 0.0}


