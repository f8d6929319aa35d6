"""Findings about a record or a result.

A finding is an explanation of what the estimated model leaves of the data, a property of the
estimate, or something that happened to the record. All have one scale: how much better it explains
the data, and how far it moves each parameter. Statuses, verdict and warnings follow from the
findings in one place, `sysid.judgement.conclusions`.
"""

from dataclasses import dataclass
from typing import Literal

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
EstimateStatus = Literal[
    "identified",
    "not settled",
    "refuted",
    "dependent",
    "ambiguous",
    "group",
    "at bound",
    "unidentifiable",
    "fixed",
    "tied",
    "unfinished",
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
    channels : tuple of str
        Channels of the recording that it is about.
    spans : tuple of (float, float)
        Where in the recording it is, from a time to a time (s); none if it is everywhere.
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
    channels: tuple[str, ...] = ()
    spans: tuple[tuple[float, float], ...] = ()

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
