"""Identified model with its values, and its linear form with constant coefficients.

The linear form is derived from the expression trees of the equations.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

from sysid.core.errors import SysidError
from sysid.core.text import plain_estimate, plain_unit
from sysid.core.types import FloatArray
from sysid.core.units import is_blank_unit
from sysid.data.records import Hold
from sysid.kernels.signals.past_reads import is_difference
from sysid.language.delays import has_varying_delay
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
from sysid.models.model import Model, ModelSignal, Output


@dataclass(frozen=True, slots=True)
class IdentifiedValue:
    """Value of one parameter or initial state, estimated or given.

    Attributes
    ----------
    name : str
        Name of the parameter, or of the initial state as ``x(0)``.
    value : float
        Value, in `unit`.
    unit : str
        Unit of value and standard error.
    stderr : float or None
        Standard error, in `unit`; none without one.
    status : str
        Status of the estimate; empty if the value was given.
    """

    name: str
    value: float
    unit: str = "1"
    stderr: float | None = None
    status: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Covariance:
    """Covariance of the free parameters, in products of their units.

    Attributes
    ----------
    names : tuple of str
        Parameters of the rows and columns.
    matrix : FloatArray, shape (D, D)
        Rows of the matrix.
    """

    names: tuple[str, ...]
    matrix: FloatArray


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class IdentifiedModel:
    """A model with values for all its parameters.

    Attributes
    ----------
    model : Model
    values : tuple of IdentifiedValue
        Every parameter in the model's order, then initial states named as in `Problem`.
    covariance : Covariance or None
    sample_time : float or None
        Sampling period of the data in s; None if unknown or irregular.
    holds : mapping of str to {"zero", "first", "band-limited", "mean", "mean-after"}
        Behaviour of the inputs between their samples; default ``first``.
    version : str
        Version of the program that writes the text.
    provenance : mapping
        Run, data sets with their hashes, dates: JSON values, written unchanged.
    units : mapping of str to str
        Units of the recorded channels by signal, for signals without a unit in the model.
    """

    model: Model
    values: tuple[IdentifiedValue, ...]
    covariance: Covariance | None = None
    sample_time: float | None = None
    holds: Mapping[str, Hold] = field(default_factory=dict)
    version: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def from_numbers(cls, model: Model, numbers: Mapping[str, float]) -> Self:
        """Give a model values that have no units and no errors."""
        return cls(model, tuple(IdentifiedValue(name, value) for name, value in numbers.items()))

    def __repr__(self) -> str:
        values = (
            f"  {value.name} = {plain_estimate(value.value, value.stderr, status=value.status)}"
            f"{plain_unit(value.unit)}"
            for value in self.values
        )
        return "\n".join([f"Identified model {self.model.name!r}", *values])

    @property
    def parameter_values(self) -> dict[str, float]:
        """Values by name."""
        return {value.name: value.value for value in self.values}

    def find_value(self, name: str) -> IdentifiedValue | None:
        """Find the value of a name, if there is one."""
        return next((value for value in self.values if value.name == name), None)

    def get_hold(self, signal: str) -> Hold:
        """Get the behaviour of an input between its samples."""
        return self.holds.get(signal, "first")

    def get_unit(self, signal: ModelSignal | Output) -> str:
        """Get the unit of an input or output: the model's, else that of the recorded channel."""
        blank = is_blank_unit(signal.unit)
        return self.units.get(signal.name, signal.unit) if blank else signal.unit


class NotLinear(SysidError, ValueError):
    """A model has no transfer function; the message names the term that prevents it."""


class DelayedSignal(NamedTuple):
    """A state or an input, `delay` s (differential form) or samples (difference) ago."""

    name: str
    kind: str
    delay: float


@dataclass(frozen=True, slots=True)
class AffineForm:
    """Σ coefficient · signal + constant."""

    terms: Mapping[DelayedSignal, float]
    constant: float = 0.0

    def add_scaled(self, other: "AffineForm", factor: float = 1.0) -> "AffineForm":
        """Add a multiple of another form."""
        terms = dict(self.terms)
        for signal, coefficient in other.terms.items():
            terms[signal] = terms.get(signal, 0.0) + factor * coefficient
        nonzero = {signal: value for signal, value in terms.items() if value != 0.0}
        return AffineForm(nonzero, self.constant + factor * other.constant)

    def scale_by(self, factor: float) -> "AffineForm":
        """Multiply by a number."""
        return AffineForm({}).add_scaled(self, factor)


@dataclass(frozen=True, slots=True)
class LinearForm:
    """Equations and outputs of a model as affine forms, in the model's order."""

    equations: tuple[AffineForm, ...]
    outputs: tuple[AffineForm, ...]


def to_linear_form(identified: IdentifiedModel, period: float | None) -> LinearForm:
    """Convert a model to its linear form.

    Parameters
    ----------
    identified : IdentifiedModel
    period : float or None
        Integration step of a difference equation in s, which its coefficients may contain.

    Raises
    ------
    NotLinear
        If a term is not linear in states and inputs, or its coefficient changes with time.
    """
    model = identified.model
    clock = "k" if is_difference(model) else "t"
    numbers = identified.parameter_values

    def substitute_known(node: Expression) -> Expression | None:
        match node:
            case Symbol(name, "parameter"):
                return Number(numbers[name])
            case Symbol(_, "period") if period is not None:
                return Number(period)
        return None

    return LinearForm(
        tuple(
            _AffineReader(f"the equation of {state.name}", clock, substitute_known).to_affine(tree)
            for state, tree in zip(model.states, model.equations, strict=True)
        ),
        tuple(
            _AffineReader(f"the output {output.name}", clock, substitute_known).to_affine(
                output.expression
            )
            for output in model.outputs
        ),
    )


@dataclass(frozen=True, slots=True)
class _AffineReader:
    description: str
    clock: str
    substitute_known: Callable[[Expression], Expression | None]

    def to_affine(self, tree: Expression) -> AffineForm:
        """Convert a tree to an affine form; terms of parameters are evaluated."""
        if not self._has_signals(tree):
            return AffineForm({}, self._evaluate_constant(tree))
        match tree:
            case PastValue(name) if has_varying_delay(tree):
                raise NotLinear(
                    f"{self.description} reads {name} with a lag that changes with an input, so it "
                    "has no transfer function"
                )
            case PastValue(name, kind, offset, unknown_delay):
                delay = offset + (
                    0.0
                    if unknown_delay is None
                    else max(self._evaluate_constant(unknown_delay), 0.0)
                )
                return AffineForm({DelayedSignal(name, kind, float(delay)): 1.0})
            case Unary("-", operand):
                return self.to_affine(operand).scale_by(-1.0)
            case Binary("+" | "-" as sign, left, right):
                return self.to_affine(left).add_scaled(
                    self.to_affine(right), 1.0 if sign == "+" else -1.0
                )
            case Binary("*", left, right):
                return self._read_product(tree, left, right)
            case Binary("/", left, right) if not self._has_signals(right):
                return self._read_quotient(tree, left, right)
        return self._read_other(tree)

    def _read_other(self, tree: Expression) -> AffineForm:
        """Read a first power, or a choice with a constant condition; others are not linear."""
        match tree:
            case Binary("**", base, Number(1.0)):
                return self.to_affine(base)
            case FunctionCall("where", (condition, first, second)) if not self._has_signals(
                condition
            ):
                return self.to_affine(first if self._evaluate_constant(condition) else second)
        raise self._make_refusal(tree)

    def _evaluate_constant(self, tree: Expression) -> float:
        return evaluate_expression(substitute(tree, self.substitute_known), {})

    def _read_product(self, tree: Expression, left: Expression, right: Expression) -> AffineForm:
        """Read a product with a constant factor; a factor 0 removes any other."""
        for factor_tree, other in ((left, right), (right, left)):
            if not self._has_signals(factor_tree):
                factor = self._evaluate_constant(factor_tree)
                return self.to_affine(other).scale_by(factor) if factor != 0.0 else AffineForm({})
        raise self._make_refusal(tree)

    def _read_quotient(self, tree: Expression, left: Expression, right: Expression) -> AffineForm:
        divisor = self._evaluate_constant(right)
        if divisor == 0.0:
            raise NotLinear(
                f"{self.description} divides by zero in {format_expression(tree, self.clock)}"
            )
        return self.to_affine(left).scale_by(1.0 / divisor)

    def _has_signals(self, tree: Expression) -> bool:
        for node in walk(tree):
            match node:
                case PastValue():
                    return True
                case Symbol(name, "time" | "index"):
                    raise NotLinear(
                        f"{self.description} changes with {name}, so it has no transfer function"
                    )
        return False

    def _make_refusal(self, tree: Expression) -> NotLinear:
        text = format_expression(tree, self.clock)
        return NotLinear(
            f"{self.description} is not linear in states and inputs: {text}; "
            "only a linear model has a transfer function"
        )
