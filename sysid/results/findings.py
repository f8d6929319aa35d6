"""Findings about a result, and the verdict that follows from them.

A finding is an explanation of what the estimated model leaves of the data, or of the estimate
itself. All have one scale: how much better it explains the data, and how far it moves each
parameter. Statuses, verdict and warnings follow from the findings in one place,
`sysid.judgement.conclusions`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from sysid.core.text import join_names
from sysid.uncertainty.estimates import Estimate, EstimateStatus

Severity = Literal["note", "caution", "serious"]
Family = Literal[
    "constancy",
    "clocks",
    "sensor",
    "actuator",
    "variance",
    "input",
    "reading",
    "start",
    "history",
    "structure",
    "noise",
    "search",
    "identifiability",
    "validation",
    "record",
    "numerics",
]

_OF_NOISE = ("outliers", "unequal variance", "coloured noise")


@dataclass(frozen=True, slots=True)
class Move:
    """What a parameter would be under an explanation.

    Attributes
    ----------
    parameter : str
        Name of the parameter.
    value : float
        What it would be, in its unit.
    stderr : float or None
        Its standard error there, in its unit; none if unknown.
    stderrs : float
        How far that is from the estimate, in standard errors of the estimate.
    """

    parameter: str
    value: float
    stderr: float | None
    stderrs: float


@dataclass(frozen=True, slots=True)
class Finding:
    """One explanation of what is left of the data, or one property of the estimate.

    Attributes
    ----------
    explanation : str
        Its name, such as ``change of a parameter``.
    family : Family
        What is explained otherwise: the sensor, the clocks, the structure of the model, and so on.
    severity : {"serious", "caution", "note"}
        Serious: no estimate can be relied on. Caution: those of `parameters` cannot, or not without
        the condition. Note: worth knowing, and moves nothing.
    brief : str
        A few words, as they follow “trustworthy, but” or “not trustworthy:”.
    text : str
        Whole sentences: what was found.
    advice : str
        What helps; a setting where there is one. Empty if nothing does.
    gain : float or None
        How much lower Schwarz's criterion is with the explanation: twice the logarithm of the odds.
        None where no likelihood is compared.
    moves : tuple of Move
        What each parameter would be, the furthest move first.
    parameters : tuple of str
        Parameters that it makes doubtful; those that a note is about.
    status : EstimateStatus
        Status that these have then.
    reason : str
        Why, as it follows the status of a parameter that has no move.
    """

    explanation: str
    family: Family
    severity: Severity
    brief: str
    text: str
    advice: str = ""
    gain: float | None = None
    moves: tuple[Move, ...] = ()
    parameters: tuple[str, ...] = ()
    status: EstimateStatus = "dependent"
    reason: str = ""

    @property
    def sentences(self) -> str:
        """The text with the advice."""
        return f"{self.text} {self.advice}".rstrip()

    @property
    def is_of_noise(self) -> bool:
        """Whether it explains the noise, beside whatever explains the rest."""
        return self.explanation in _OF_NOISE


def note(explanation: str, family: Family, text: str) -> Finding:
    """Make a finding that is worth knowing, and moves nothing.

    Examples
    --------
    >>> note("unequal noise", "variance", "the noise is unequal").severity
    'note'
    """
    return Finding(explanation, family, "note", explanation, text)


def list_moves(
    estimates: Sequence[Estimate],
    values: Mapping[str, float],
    stderrs: Mapping[str, float | None],
    own: Mapping[str, float] | None = None,
) -> tuple[Move, ...]:
    """List how far other values are from estimates that have an error, the furthest first.

    They move from the `own` values, if these are not the estimates.

    Examples
    --------
    >>> lag = Estimate("L", "s", 5.0, 0.0, 9.0, 0.5, (4.0, 6.0), "identified")
    >>> list_moves([lag], {"L": 6.5}, {})
    (Move(parameter='L', value=6.5, stderr=None, stderrs=3.0),)
    """
    own = {one.name: one.value for one in estimates} if own is None else own
    moves = [
        Move(name, values[name], stderrs.get(name), (values[name] - own[name]) / one.stderr)
        for one in estimates
        if (name := one.name) in values and name in own and one.stderr
    ]
    return order_moves(moves)


def order_moves(moves: Iterable[Move]) -> tuple[Move, ...]:
    """Order moves, the furthest first."""
    return tuple(sorted(moves, key=lambda move: -abs(move.stderrs)))


def list_untold_reasons(estimates: Sequence[Estimate], findings: Sequence[Finding]) -> list[str]:
    """List the reasons of statuses that no finding tells, each once with its parameters.

    Examples
    --------
    >>> lag = Estimate("L", "s", 5.0, 0.0, 5.0, None, None, "fixed", "it was fixed")
    >>> list_untold_reasons([lag], [])
    ['L: it was fixed']
    """
    told = {name for one in findings for name in one.parameters}
    is_for_all = any(one.severity == "serious" and not one.parameters for one in findings)
    names: dict[str, list[str]] = {}
    for estimate in estimates:
        is_told = estimate.name in told or (is_for_all and estimate.status == "dependent")
        if estimate.reason and not is_told:
            names.setdefault(estimate.reason, []).append(estimate.name)
    return [f"{join_names(some)}: {reason}" for reason, some in names.items()]
