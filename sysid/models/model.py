"""A checked model: equations as trees, parameters, initial states, solver, polynomial terms."""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal, NamedTuple

from sysid.language.printer import format_expression
from sysid.language.tree import Expression, PastValue
from sysid.models.parameters import BoundsRule, Parameter

Criterion = Literal["none", "bic"]
ErrorKind = Literal["auto", "one-step", "simulation"]
MAX_SUBSTEPS = 1000
"""Most integration steps in one grid step."""


@lru_cache(maxsize=2048)
def _write_product(factors: tuple[PastValue, ...]) -> str:
    powers = Counter(format_expression(factor).replace(" ", "") for factor in factors)
    return "*".join(f"{name}**{n}" if n > 1 else name for name, n in powers.items()) or "1"


class Term(NamedTuple):
    """A product of past values; the empty product is the constant 1."""

    factors: tuple[PastValue, ...]

    @property
    def label(self) -> str:
        """Text of the product, such as ``y(k-1)**2*u(k-1-dk)``."""
        return _write_product(self.factors)

    @property
    def coefficient_name(self) -> str:
        """Name of the term's coefficient: ``a[y(k-1)*u(k-1)]``."""
        return f"a[{self.label}]"


@dataclass(frozen=True, slots=True)
class TermRule:
    """Rule for the selection of a polynomial's terms on data.

    Attributes
    ----------
    keep : int
        Number of terms to select; with `err` or `criterion` the largest number.
    err : float or None
        Stop when the unexplained share of the output's sum of squares falls below this.
    criterion : {"none", "bic"}
        ``bic``: choose the number of terms with the smallest Bayesian information criterion.
    exchange : bool
        Whether a selected term may be replaced by a better one afterwards.
    error : {"auto", "one-step", "simulation"}
        Error that the terms explain. ``simulation`` starts from the one-step selection; ``auto``
        takes the one of the two that predicts better.
    """

    keep: int
    err: float | None = None
    criterion: Criterion = "none"
    exchange: bool = True
    error: ErrorKind = "auto"

    @property
    def is_fixed_number(self) -> bool:
        """Whether `keep` is the number of terms, not a limit."""
        return self.err is None and self.criterion == "none"

    @property
    def demand(self) -> "TermRule":
        """The rule for the terms that the data demand, at most `keep`."""
        return replace(self, criterion="bic") if self.is_fixed_number else self


class SelectedTerm(NamedTuple):
    """A term in the order of selection.

    Attributes
    ----------
    term : str
        The term.
    err : float
        Error-reduction ratio: the share of the output's sum of squares that this term explains
        in addition to the terms before it.
    cumulated : float
        Share explained with all terms so far.
    coefficient : float
        Coefficient in the model of all selected terms, before the search. It comes from one-step
        least squares, or from the free run if that selected the terms. Its unit follows from the
        term.
    probability : float
        Probability that the term belongs to the model: the weight of the selections with it.
    coverage : float
        Probability that the 95 % interval of the coefficient holds, over all these selections.
    rival : str
        The likeliest other selection: the change in words. Empty if term and coefficient are
        certain.
    """

    term: str
    err: float
    cumulated: float
    coefficient: float
    probability: float
    coverage: float
    rival: str


@dataclass(frozen=True, slots=True)
class Selection:
    """Result of a selection of terms.

    Attributes
    ----------
    terms : tuple of SelectedTerm
    lags : mapping of str to float
        Values of the unknown delays at which the terms explain most.
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
    """Initial value of a state that is a fixed number."""

    value: float


@dataclass(frozen=True, slots=True)
class EstimatedInitial:
    """Initial value of a state that is estimated inside these bounds, for each experiment.

    With `bounds` they follow the data.
    """

    lower: float
    upper: float
    bounds: BoundsRule | None = None


@dataclass(frozen=True, slots=True)
class MeasuredInitial:
    """Initial value of a state that is the first measured value of the output that equals it.

    A state that is the time derivative of a measured state starts at the first difference of the
    measurement.
    """


@dataclass(frozen=True, slots=True)
class DerivedInitial:
    """Initial value of a state that follows from parameters and the inputs' first values.

    `text` is what the document says: an expression such as ``K*u0``, ``steady`` or ``history``. In
    `expression`, an input without delay is its value at the start of the record.
    """

    expression: Expression
    text: str


InitialState = FixedInitial | EstimatedInitial | MeasuredInitial | DerivedInitial


@dataclass(frozen=True, slots=True)
class HistoryFunction:
    """Past of a state before the start, which its delayed reads take there.

    `expression` is a function of ``t`` < 0 (s) and parameters, without signals.
    """

    state: str
    expression: Expression


@dataclass(frozen=True, slots=True)
class NoisePlaces:
    """Places of noise inside the plant, by name: states that diffuse, and signals with loads.

    A load at an input enters the equations, and one at an output is the drift of its sensor.
    """

    plant: tuple[str, ...] = ()
    load: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Correction:
    """Changes of states after each sample of an output, whose sensor has the deviation 1/w.

    A state changes by ``gain·w²(y - ŷ)/S`` or by ``-loss·w²/S``, S = 1 + w²·variance. All
    expressions are functions of parameters and present states, as they are before the sample.

    Attributes
    ----------
    output : str
    variance : Expression
        Variance of the output that follows from the states.
    gains, losses : tuple of (str, Expression)
        By state.
    """

    output: str
    variance: Expression
    gains: tuple[tuple[str, Expression], ...]
    losses: tuple[tuple[str, Expression], ...]

    def map(self, change: Callable[[Expression], Expression]) -> "Correction":
        """Return the correction with all expressions changed."""
        gains, losses = (
            tuple((state, change(tree)) for state, tree in pairs)
            for pairs in (self.gains, self.losses)
        )
        return Correction(self.output, change(self.variance), gains, losses)


@dataclass(frozen=True, slots=True)
class Solver:
    """Integration method of a differential model, and reading of past values.

    Attributes
    ----------
    method : {"rk4", "euler", "semi-implicit"}
        ``semi-implicit`` updates the states in order, each with those already updated.
    step : float or None
        Grid of the simulation in s; None: the sampling period of the outputs.
    substeps : int
        Integration steps in one grid step. In the difference form `k` counts these steps and `h`
        is their length. So a stiff recursion may be finer than the sampling.
    history : {"constant", "zero"}
        States before the start that have no history function: their initial value, or zero.
    interpolation : {"linear", "cubic", "nearest"}
        Interpolation between two grid points.
    """

    method: SolverMethod = "rk4"
    step: float | None = None
    substeps: int = 1
    history: HistoryKind = "constant"
    interpolation: InterpolationKind = "linear"


@dataclass(frozen=True, slots=True)
class Model:
    """A model whose document has passed all checks.

    A polynomial document becomes a difference equation; `form` remains ``polynomial``.
    `equations` holds one tree for each state, in the states' order: dx/dt, or x(k). In the
    difference form a tree may read another state at the present sample. `order` (indices into
    `states`) is the order of computation. `memory` is the largest fixed offset of any past value
    (difference form): the first `memory` samples are measured or initial values. `document` is
    the normal form, from which the model can be built again. `histories` are those of states with a
    history function, in the states' order. `noise` has the places that the document names.
    `corrections` are those of a Kalman filter (`sysid.models.kalman_filter`), whose states are not
    in the document.

    `terms` are the terms of a polynomial, in the order of their coefficients. With a `rule` they
    are candidates. `sysid.selection.select.select_model_terms` selects among them on records. Its
    result is the resolved model's `selection`.
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
    histories: tuple[HistoryFunction, ...] = ()
    noise: NoisePlaces = NoisePlaces()
    corrections: tuple[Correction, ...] = ()

    def find_history(self, state: str) -> Expression | None:
        """Find the history function of a state; None if it has none."""
        return next((one.expression for one in self.histories if one.state == state), None)


def replace_substeps(model: Model, substeps: int) -> Model:
    """Return a model with another number of substeps, in its solver and its document."""
    solver = {**model.document.get("solver", {}), "substeps": substeps}
    return replace(
        model,
        solver=replace(model.solver, substeps=substeps),
        document={**model.document, "solver": solver},
    )


def name_initial_state(state: str, experiment: int) -> str:
    """Name an estimated initial state: ``x(0)``, in the second experiment ``x(0)[2]``."""
    return f"{state}(0)" if experiment == 0 else f"{state}(0)[{experiment + 1}]"


def build_initial_parameters(model: Model, experiments: int) -> tuple[Parameter, ...]:
    """Build the parameters of the estimated initial states, for each experiment."""
    return tuple(
        Parameter(
            name_initial_state(state.name, e),
            start.lower,
            start.upper,
            state.unit,
            bounds=start.bounds,
        )
        for e in range(experiments)
        for state, start in zip(model.states, model.initial, strict=True)
        if isinstance(start, EstimatedInitial)
    )
