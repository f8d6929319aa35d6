"""A checked model: equations as trees, parameters with bounds, how to start and how to solve.

Terms of a polynomial, how many of them are wanted, and what a selection has found.

Initial states that are to be estimated, as parameters: once for each experiment.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from sysid.language.printer import format_expression
from sysid.language.tree import Expression, PastValue
from sysid.models.parameters import Parameter

Criterion = Literal["none", "bic"]
ErrorKind = Literal["one-step", "simulation"]


class Term(NamedTuple):
    """A product of past values; the empty one is the constant 1."""

    factors: tuple[PastValue, ...]

    @property
    def label(self) -> str:
        """Text of the product, such as ``y(k-1)**2*u(k-1-dk)``."""
        if not self.factors:
            return "1"
        powers = {format_expression(factor).replace(" ", ""): 0 for factor in self.factors}
        for factor in self.factors:
            powers[format_expression(factor).replace(" ", "")] += 1
        return "*".join(f"{name}**{n}" if n > 1 else name for name, n in powers.items())

    @property
    def coefficient_name(self) -> str:
        """Name of the term's coefficient: ``a[y(k-1)*u(k-1)]``."""
        return f"a[{self.label}]"


@dataclass(frozen=True, slots=True)
class TermRule:
    """How the terms of a model are to be selected on the data.

    Attributes
    ----------
    keep : int
        Number of terms; with `err` or `criterion` the largest number.
    err : float or None
        Stop when the share of the output's squares that is not explained falls below this.
    criterion : {"none", "bic"}
        ``bic``: the number of terms with the least Bayesian information criterion.
    exchange : bool
        Whether a taken term may give way to a better one afterwards.
    error : {"one-step", "simulation"}
        Which error the terms are to explain; the latter begins with the former.
    """

    keep: int
    err: float | None = None
    criterion: Criterion = "none"
    exchange: bool = True
    error: ErrorKind = "one-step"


class SelectedTerm(NamedTuple):
    """One term in the order of selection.

    Attributes
    ----------
    err : float
        Error-reduction ratio: the share of the output's squares that this term explains beyond
        the terms before it.
    cumulated : float
        Share explained with all terms so far.
    coefficient : float
        Coefficient in the model of all selected terms, before the search: by least squares one
        step ahead, or on the free run where the terms were selected by that.
    """

    term: str
    err: float
    cumulated: float
    coefficient: float


@dataclass(frozen=True, slots=True)
class Selection:
    """What a selection has found.

    Attributes
    ----------
    terms : tuple of SelectedTerm
    lags : mapping of str to float
        Values of the unknown lags at which the terms explain most.
    samples : int
        Rows of the regression.
    """

    terms: tuple[SelectedTerm, ...]
    lags: Mapping[str, float] = field(default_factory=dict)
    samples: int = 0


ModelForm = Literal["difference", "differential", "polynomial"]
SolverMethod = Literal["rk4", "euler", "semi-implicit"]
HistoryKind = Literal["constant", "zero"]
InterpolationKind = Literal["linear", "cubic", "nearest"]


@dataclass(frozen=True, slots=True)
class ModelSignal:
    """A named signal and its unit (``"1"`` if it has none)."""

    name: str
    unit: str = "1"


@dataclass(frozen=True, slots=True)
class Output:
    """A measured channel and the expression that predicts it."""

    name: str
    expression: Expression
    unit: str = "1"


@dataclass(frozen=True, slots=True)
class FixedInitial:
    """The state starts at a known value."""

    value: float


@dataclass(frozen=True, slots=True)
class EstimatedInitial:
    """The state's start is estimated, for each experiment on its own, inside these bounds."""

    lower: float
    upper: float


@dataclass(frozen=True, slots=True)
class MeasuredInitial:
    """The state starts at the first measured value of the output that equals it.

    For a state that is the time derivative of a measured one (its equation is that state's
    rate), at the first difference of the measurement.
    """


InitialState = FixedInitial | EstimatedInitial | MeasuredInitial


@dataclass(frozen=True, slots=True)
class Solver:
    """How a differential model is integrated and how past values are read.

    Attributes
    ----------
    method : {"rk4", "euler", "semi-implicit"}
        ``semi-implicit`` updates the states in their order, each using those already updated.
    step : float or None
        Grid of the simulation in s; None: the sampling period of the outputs.
    substeps : int
        Integration steps in one grid step. In the difference form `k` counts these and `h` is
        their length, so that a stiff recursion may be finer than the sampling.
    history : {"constant", "zero"}
        States before the start: their initial value, or zero.
    interpolation : {"linear", "cubic", "nearest"}
        How a value between two grid points is read.
    """

    method: SolverMethod = "rk4"
    step: float | None = None
    substeps: int = 1
    history: HistoryKind = "constant"
    interpolation: InterpolationKind = "linear"


@dataclass(frozen=True, slots=True)
class Model:
    """A model whose document has passed all checks.

    A polynomial document becomes its difference equation here; `form` still says ``polynomial``.
    `equations` holds one tree per state, in the states' order: dx/dt, or x(k). In the difference
    form a tree may use another state at the present sample; the order in which the states are to
    be computed is `order` (indices into `states`). `memory` is the largest fixed offset of any
    past value (difference form): the first `memory` samples are given, not computed.
    `document` is the normal form, from which the model can be built again.

    Of a polynomial, `terms` are its terms, in the order of their coefficients. With a `rule` they
    are candidates only: `sysid.selection.select.select_model_terms` resolves it on records, and
    what it has found is the resolved model's `selection`.
    """

    name: str
    title: str
    form: ModelForm
    inputs: tuple[ModelSignal, ...]
    states: tuple[ModelSignal, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[Parameter, ...]
    equations: tuple[Expression, ...]
    initial: tuple[InitialState, ...]
    order: tuple[int, ...]
    memory: int
    solver: Solver
    document: Mapping[str, Any]
    terms: tuple[Term, ...] = ()
    rule: TermRule | None = None
    selection: Selection | None = field(default=None, compare=False)


def name_initial_state(state: str, experiment: int) -> str:
    """Name of an estimated initial state: ``x(0)``, in the second experiment ``x(0)[2]``."""
    return f"{state}(0)" if experiment == 0 else f"{state}(0)[{experiment + 1}]"


def build_initial_parameters(model: Model, experiments: int) -> tuple[Parameter, ...]:
    """The initial states to be estimated, for each experiment on its own."""
    return tuple(
        Parameter(name_initial_state(state.name, e), start.lower, start.upper, state.unit)
        for e in range(experiments)
        for state, start in zip(model.states, model.initial, strict=True)
        if isinstance(start, EstimatedInitial)
    )
