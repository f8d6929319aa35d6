"""A checked model: equations as trees, parameters with bounds, how to start and how to solve."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from sysid.language.tree import Expression
from sysid.models.terms import Selection, Term, TermRule
from sysid.parameters import Parameter

Form = Literal["difference", "differential", "polynomial"]
Method = Literal["euler", "semi-implicit", "rk4"]
History = Literal["constant", "zero"]
Interpolation = Literal["linear", "cubic", "nearest"]


@dataclass(frozen=True, slots=True)
class Quantity:
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


Initial = FixedInitial | EstimatedInitial | MeasuredInitial


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

    method: Method = "rk4"
    step: float | None = None
    substeps: int = 1
    history: History = "constant"
    interpolation: Interpolation = "linear"


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
    are candidates only: `sysid.selection.selected` resolves it on records, and what it has found
    is the resolved model's `selection`.
    """

    name: str
    title: str
    form: Form
    inputs: tuple[Quantity, ...]
    states: tuple[Quantity, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[Parameter, ...]
    equations: tuple[Expression, ...]
    initial: tuple[Initial, ...]
    order: tuple[int, ...]
    memory: int
    solver: Solver
    document: Mapping[str, Any]
    terms: tuple[Term, ...] = ()
    rule: TermRule | None = None
    selection: Selection | None = field(default=None, compare=False)
