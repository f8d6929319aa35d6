"""Whether a model is linear with constant coefficients, found from its trees, and its matrices.

What is exported: a model, the values found for it, and where they come from.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from sysid.core.errors import SysidError
from sysid.core.types import FloatArray
from sysid.data.records import Hold
from sysid.kernels.reads import is_difference
from sysid.language.evaluation import value as number_of
from sysid.language.printer import text
from sysid.language.transform import substitute
from sysid.language.tree import Binary, Call, Expression, Number, Past, Symbol, Unary, walk
from sysid.models.model import Model


@dataclass(frozen=True, slots=True)
class Value:
    """One parameter, or initial state of an experiment, as found; `stderr` in `unit`."""

    name: str
    value: float
    unit: str = "1"
    stderr: float | None = None
    status: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """Covariance (D, D) of the free parameters `names`, in products of their units."""

    names: tuple[str, ...]
    matrix: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """A model with values for all its parameters.

    Attributes
    ----------
    model : Model
    values : tuple of Value
        Every parameter in the model's order, then initial states named as in `Problem`.
    covariance : Covariance or None
    sample_time : float or None
        Sampling period of the data in s; None where it is not known or not regular.
    holds : mapping of str to {"zero", "first", "band-limited"}
        How the inputs were held between their samples; ``first`` where nothing is said.
    version : str
        Version of the program that writes the text.
    provenance : mapping
        Run, data sets with their hashes, dates: JSON values, told as they are.
    """

    model: Model
    values: tuple[Value, ...]
    covariance: Covariance | None = None
    sample_time: float | None = None
    holds: Mapping[str, Hold] = field(default_factory=dict)
    version: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def numbers(self) -> dict[str, float]:
        """Value of each name."""
        return {one.name: one.value for one in self.values}

    def find(self, name: str) -> Value | None:
        """The value of that name, if there is one."""
        return next((one for one in self.values if one.name == name), None)

    def hold(self, signal: str) -> Hold:
        """How an input was held between its samples."""
        return self.holds.get(signal, "first")


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

    return Linear(
        tuple(
            _Reader(f"the equation of {state.name}", clock, known).affine(tree)
            for state, tree in zip(model.states, model.equations, strict=True)
        ),
        tuple(
            _Reader(f"the output {one.name}", clock, known).affine(one.expression)
            for one in model.outputs
        ),
    )


@dataclass(frozen=True, slots=True)
class _Reader:
    where: str
    clock: str
    known: Callable[[Expression], Expression | None]

    def affine(self, tree: Expression) -> Affine:
        """The tree as an affine form; what it says of parameters is computed."""
        if not self._has_signals(tree):
            return Affine({}, self._number(tree))
        match tree:
            case Past(name, kind, offset, lag):
                delay = offset + (0.0 if lag is None else max(self._number(lag), 0.0))
                return Affine({Signal(name, kind, float(delay)): 1.0})
            case Unary("-", operand):
                return self.affine(operand).times(-1.0)
            case Binary("+" | "-" as sign, left, right):
                return self.affine(left).plus(self.affine(right), 1.0 if sign == "+" else -1.0)
            case Binary("*", left, right):
                return self._product(tree, left, right)
            case Binary("/", left, right) if not self._has_signals(right):
                return self._quotient(tree, left, right)
        return self._other(tree)

    def _other(self, tree: Expression) -> Affine:
        """A first power, or a choice that numbers decide; nothing else is linear."""
        match tree:
            case Binary("**", base, Number(1.0)):
                return self.affine(base)
            case Call("where", (condition, first, second)) if not self._has_signals(condition):
                return self.affine(first if self._number(condition) else second)
        raise self._refusal(tree)

    def _number(self, tree: Expression) -> float:
        return number_of(substitute(tree, self.known), {})

    def _product(self, tree: Expression, left: Expression, right: Expression) -> Affine:
        """A factor that is 0 takes its term away, whatever that is."""
        for one, other in ((left, right), (right, left)):
            if not self._has_signals(one):
                factor = self._number(one)
                return self.affine(other).times(factor) if factor != 0.0 else Affine({})
        raise self._refusal(tree)

    def _quotient(self, tree: Expression, left: Expression, right: Expression) -> Affine:
        divisor = self._number(right)
        if divisor == 0.0:
            raise NotLinear(f"{self.where} divides by zero in {text(tree, self.clock)}")
        return self.affine(left).times(1.0 / divisor)

    def _has_signals(self, tree: Expression) -> bool:
        for node in walk(tree):
            match node:
                case Past():
                    return True
                case Symbol(name, "time" | "index"):
                    raise NotLinear(
                        f"{self.where} changes with {name}, so it has no transfer function"
                    )
        return False

    def _refusal(self, tree: Expression) -> NotLinear:
        return NotLinear(
            f"{self.where} is not linear in states and inputs: {text(tree, self.clock)}; "
            "only a linear model has a transfer function"
        )
